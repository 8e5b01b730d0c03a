"""Sessions: open, look at, submit occupancy, close; save at shutdown and restore at start. Steps go to the engine."""

from __future__ import annotations

import asyncio
import logging

import numpy as np

from surrogym_server.engine.core import limits_rewards
from surrogym_server.engine.port import SessionEngine
from surrogym_server.engine.requests import Array, Open, Opening, Restore, SampledRewards, Saved, SessionInfo
from surrogym_server.engine.tallies import SessionActivity
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.errors import Damaged, SurrogymError, UnknownSession
from surrogym_server.services.definitions import Definitions
from surrogym_server.storage.port import Storage
from surrogym_server.storage.records import SavedSession

MOST_STARTS = 10_000  # states of real steps at which the episodes of a session start

logger = logging.getLogger(__name__)


class SessionService:
    """Opens, describes, saves and restores sessions. It connects their engine with the storage."""

    def __init__(self, storage: Storage, definitions: Definitions, engine: SessionEngine) -> None:
        self._storage = storage
        self._definitions = definitions
        self._engine = engine

    @property
    def idle_seconds(self) -> float:
        return self._engine.idle_seconds

    @property
    def replay(self) -> int:
        """Number of its last requests that a client should keep, to repeat them after a checkpoint."""
        return self._engine.replay

    async def open(self, surrogate: str, opening: Opening) -> SessionInfo:
        """Open a session; raises ``UnknownSurrogate``, and as ``SessionEngine.open``."""
        return await self._engine.open(await asyncio.to_thread(self._request, surrogate, opening))

    async def get(self, id: str) -> SessionInfo:
        """Return a session's present state.

        Raises:
            UnknownSession: the session does not exist, or it went back to a checkpoint before its last reply.
            SessionExpired: the session was idle for too long.
        """
        info = await self._engine.describe(id)
        if info.behind:  # a caller that asks for the session's state has kept no requests to repeat
            raise UnknownSession(f"session {id!r} lost its session host, and is behind its last reply: open a new one")
        return info

    async def coordinates(self, id: str) -> Array:
        """Return the coordinates of all lanes, (N, C). Raises ``UnknownSession`` or ``SessionExpired``."""
        return await self._engine.coordinates(id)

    async def close(self, id: str) -> None:
        """End a session; harmless when it has ended."""
        await self._engine.close(id)

    async def submit_occupancy(self, id: str, checkpoint: str) -> tuple[int, float]:
        """Store the states that a session visited under a checkpoint's name. Return their number, and the confidence
        index over them. The surrogate is found by its id, because another surrogate may have its name by now.

        Raises:
            InvalidInput: the session was opened without occupancy.
            NotReset: nothing was visited yet.
            UnknownSurrogate: it was deleted by another server.
        """
        visits = await self._engine.submit(id)
        name = await asyncio.to_thread(self._storage.surrogates.name_of, visits.surrogate_id)
        await asyncio.to_thread(self._storage.occupancy.put, name, checkpoint, visits.states)
        return len(visits.states), visits.confidence_index

    async def activity(self, surrogate: str) -> list[SessionActivity]:
        """Return the activity of a surrogate's open sessions, oldest first. Raises ``UnknownSurrogate``."""
        await asyncio.to_thread(self._storage.surrogates.get, surrogate)
        return await self._engine.activity(surrogate)

    async def save(self) -> int:
        """Store all live sessions, and return their number."""
        sessions = [SavedSession(one.id, one.surrogate, one.data) for one in await self._engine.save()]
        self._storage.sessions.save(sessions)
        return len(sessions)

    async def restore(self) -> int:
        """Restore the saved sessions, and return how many were restored. The log names each session that can't be
        restored, and why."""
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
        """States of the surrogate's real steps, evenly spaced if there are more than ``MOST_STARTS``; None if the
        session starts no episode there."""
        if opening.settings.start_visited == 0:
            return None
        states = self._storage.samples.arrays(surrogate).coordinates
        rows = np.linspace(0, len(states) - 1, min(len(states), MOST_STARTS)).astype(int)
        starts: Array = states[rows]
        return starts

    def _rewards(self, surrogate: str, definition: EnvironmentDefinition) -> SampledRewards | None:
        limits = self._storage.samples.reward_range(surrogate) if limits_rewards(definition) else None
        return None if limits is None else SampledRewards(*limits, self._storage.samples.count(surrogate))
