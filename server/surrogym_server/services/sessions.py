"""Functions on sessions other than steps: open, describe and close a session, store the states that it visited, and
save all sessions when the server stops and restore them when it starts."""

from __future__ import annotations

import asyncio
import logging

import numpy as np

from surrogym_server.engine.port import SessionEngine
from surrogym_server.engine.requests import (
    Array,
    Open,
    Opening,
    Restore,
    SampledRewards,
    Saved,
    SessionInfo,
    limits_rewards,
)
from surrogym_server.engine.tallies import SessionActivity
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.errors import Damaged, SurrogymError, UnknownSession
from surrogym_server.services.definitions import Definitions
from surrogym_server.storage.records import SavedSession
from surrogym_server.storage.sql import Storage

MOST_STARTS = 10_000  # if episodes start at states of real steps, a session gets at most this many of these states

logger = logging.getLogger(__name__)


class SessionService:
    """Opens, describes, saves and restores sessions. It connects the session engine with the storage."""

    def __init__(self, storage: Storage, definitions: Definitions, engine: SessionEngine) -> None:
        self._storage = storage
        self._definitions = definitions
        self._engine = engine

    async def open(self, surrogate: str, opening: Opening) -> SessionInfo:
        """Open a session of a surrogate. Raises ``UnknownSurrogate``, and the errors of ``SessionEngine.open``."""
        return await self._engine.open(await asyncio.to_thread(self._request, surrogate, opening))

    async def get(self, id: str) -> SessionInfo:
        """Return a session's present state.

        Raises:
            UnknownSession: the session does not exist, or the process that ran it died and its last steps are lost.
            SessionExpired: the session was idle for too long.
        """
        info = await self._engine.describe(id)
        # A session restored from an older checkpoint needs its client's last requests, which this client does not have.
        if info.behind:
            raise UnknownSession(
                f"session {id!r} has lost its last steps, because the process that ran it died: open a new session"
            )
        return info

    async def submit_occupancy(self, id: str, checkpoint: str) -> tuple[int, float]:
        """Store the states that a session visited, under the name ``checkpoint``.

        Returns the number of states, and the confidence index of the session's model over them.

        Raises:
            InvalidInput: the session was opened without the option ``occupancy``, which records visited states.
            NotReset: the session has visited no state yet.
            UnknownSurrogate: another server deleted the surrogate.
        """
        visits = await self._engine.submit(id)
        # The surrogate is found by its id, because it may have been deleted and another one may have its name.
        name = await asyncio.to_thread(self._storage.surrogates.name_of, visits.surrogate_id)
        await asyncio.to_thread(self._storage.occupancy.put, name, checkpoint, visits.states)
        return len(visits.states), visits.confidence_index

    async def activity(self, surrogate: str) -> list[SessionActivity]:
        """Return steps, returns and idle time of each open session of a surrogate, oldest first.

        Raises ``UnknownSurrogate``.
        """
        await asyncio.to_thread(self._storage.surrogates.get, surrogate)
        return await self._engine.activity(surrogate)

    async def save(self) -> int:
        """Store all live sessions, and return their number."""
        sessions = [SavedSession(one.id, one.surrogate, one.data) for one in await self._engine.save()]
        self._storage.sessions.save(sessions)
        return len(sessions)

    async def restore(self) -> int:
        """Restore the saved sessions, and return their number. Each session that can't be restored is logged."""
        try:
            saved_sessions = self._storage.sessions.take()
        except Damaged as error:
            logger.error("the saved sessions can't be read, so trainers must open new ones: %s", error)
            return 0
        return sum([await self._restored(session) for session in saved_sessions])

    async def _restored(self, session: SavedSession) -> bool:
        try:
            record = self._storage.surrogates.get(session.surrogate)
            data = Saved(session.id, session.surrogate, session.data)
            await self._engine.restore(Restore(data, record.id, self._definitions.of(record)))
        except SurrogymError as error:
            logger.warning("the saved session %s is lost: %s", session.id, error)
            return False
        return True

    def _request(self, surrogate: str, opening: Opening) -> Open:
        record = self._storage.surrogates.get(surrogate)
        definition = self._definitions.of(record)
        rewards, starts = self._rewards(surrogate, definition), self._starts(surrogate, opening)
        return Open(surrogate, record.id, definition, opening, rewards, starts)

    def _starts(self, surrogate: str, opening: Opening) -> Array | None:
        """Return the states (n, C) of n real steps of the surrogate, at which the session may start episodes. If there
        are more than ``MOST_STARTS``, return that many, evenly spaced in their order.

        Return None if the setting ``start_visited`` is 0, so that no episode starts at such a state.
        """
        if opening.settings.start_visited == 0:
            return None
        states = self._storage.samples.arrays(surrogate).coordinates
        rows = np.linspace(0, len(states) - 1, min(len(states), MOST_STARTS)).astype(int)
        starts: Array = states[rows]
        return starts

    def _rewards(self, surrogate: str, definition: EnvironmentDefinition) -> SampledRewards | None:
        limits = self._storage.samples.reward_range(surrogate) if limits_rewards(definition) else None
        return None if limits is None else SampledRewards(*limits, self._storage.samples.count(surrogate))
