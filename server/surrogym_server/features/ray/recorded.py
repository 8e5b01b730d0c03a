"""``RecordedEngine``: runs the sessions of one process under leases, with checkpoints in the database."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, replace

from surrogym_server.engine.local import LocalEngine, OpeningLocks
from surrogym_server.engine.port import SessionEngine
from surrogym_server.engine.requests import Advance, Array, Open, Reply, Restore, Saved, SessionInfo, Visited
from surrogym_server.engine.tallies import Counts, SessionActivity
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.errors import (
    Damaged,
    IdempotencyConflict,
    InvalidInput,
    SeqConflict,
    SurrogymError,
    Unavailable,
    UnknownSession,
)
from surrogym_server.features.ray.leases import Leases
from surrogym_server.features.ray.store import LiveSessions, TakenSession

UNKNOWN = -1


@dataclass(frozen=True)
class Surroundings:
    """Functions that are needed to restore a session from its checkpoint.

    Attributes:
        surrogate: returns name and environment definition of a surrogate, given its id; raises ``UnknownSurrogate``.
        refresh: loads the newest model of a surrogate, given its id, and returns its version.
    """

    surrogate: Callable[[int], tuple[str, EnvironmentDefinition]]
    refresh: Callable[[int], int]


class RecordedEngine(SessionEngine):
    """Engine that wraps the engine of this process. It carries out a request only while this process has the session's
    lease.

    A session that was taken over from another process is in the state of its last checkpoint. It refuses new requests
    until its client has repeated the requests since that checkpoint, in order.

    Args:
        inner: engine that runs the sessions.
        store: records of the sessions in the database.
        leases: leases and checkpoints of this process's sessions.
        surroundings: functions to restore sessions from checkpoints.
    """

    lasting = True

    def __init__(self, inner: LocalEngine, store: LiveSessions, leases: Leases, surroundings: Surroundings) -> None:
        self.idle_seconds = inner.idle_seconds
        self._inner = inner
        self._store = store
        self._leases = leases
        self._surroundings = surroundings
        self._opening = OpeningLocks()
        self._taking = asyncio.Lock()
        # By session that another process has taken over: number of the last request that its client has to send again.
        self._behind: dict[str, int] = {}
        self._tasks: list[asyncio.Task[None]] = []

    async def open(self, request: Open) -> SessionInfo:
        async with self._opening.of(request.surrogate_id):
            info = await self._inner.open(request)
            if not self._leases.holds(info.id):
                await self._add(info.id, request.surrogate_id)
            return info

    async def advance(self, request: Advance) -> Reply:
        id = request.session
        self._leases.require(id)
        if id in self._behind and request.seq is None:
            raise await self._lost(id, "its requests have no seq, so nobody knows which of them it lacks")
        try:
            reply = await self._inner.advance(request)
        except SeqConflict as conflict:
            if id in self._behind and request.seq is not None and request.seq > conflict.expected:
                self._behind[id] = max(self._behind[id], request.seq - 1)
            raise
        self._require_still(id)
        if id in self._behind and reply.seq >= self._behind[id]:
            del self._behind[id]
        return reply

    async def describe(self, session: str) -> SessionInfo:
        self._leases.require(session)
        return replace(await self._inner.describe(session), behind=session in self._behind)

    async def coordinates(self, session: str) -> Array:
        await self._require_up_to_date(session)
        return await self._inner.coordinates(session)

    async def submit(self, session: str) -> Visited:
        await self._require_up_to_date(session)
        return await self._inner.submit(session)

    async def close(self, session: str) -> None:
        await self._inner.close(session)
        self._behind.pop(session, None)
        await self._leases.remove(session)

    async def forget(self, surrogate: int) -> None:
        await self._inner.forget(surrogate)
        await asyncio.to_thread(self._store.remove_all_of, surrogate)
        await self._settle()

    async def activity(self, surrogate: str) -> list[SessionActivity]:
        return await self._inner.activity(surrogate)

    def counts(self) -> Counts:
        return self._inner.counts()

    async def sweep(self) -> None:
        await self._inner.sweep()
        await self._settle()

    async def start(self) -> None:
        await self._inner.start()
        loops = (self._leases.keep_renewing(), self._leases.keep_recording(self._inner.sessions))
        self._tasks = [asyncio.create_task(loop) for loop in loops]

    async def stop(self) -> None:
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self._inner.stop()

    async def save(self) -> list[Saved]:
        return await self._inner.save()

    async def restore(self, request: Restore) -> None:
        await self._inner.restore(request)
        await asyncio.to_thread(self._store.remove, request.saved.id)
        await self._add(request.saved.id, request.surrogate_id)

    async def take(self, session: str) -> SessionInfo:
        """Take over a session whose host has died, in the state of its last checkpoint, and return its description.

        Raises:
            UnknownSession: the session can't be continued; the message gives the reason.
            Unavailable: the lease of another host has not expired.
            Overloaded: this process has no room for the session; another host may have.
        """
        async with self._taking:
            if not self._leases.holds(session):
                await self._restored(session, await self._leases.take(session))
                self._behind[session] = UNKNOWN
            return await self.describe(session)

    async def _add(self, id: str, surrogate_id: int) -> None:
        try:
            await self._leases.add(self._inner.session(id), surrogate_id)
        except BaseException as error:
            await self._inner.close(id)
            if isinstance(error, IdempotencyConflict):
                raise Unavailable(
                    "another session host is opening a session with this idempotency key: try again later"
                ) from error
            raise

    async def _restored(self, id: str, taken: TakenSession) -> None:
        if taken.machine != self._leases.machine:
            raise await self._lost(
                id, "no host of the same kind of machine is left, and another kind rounds numbers differently"
            )
        if taken.checkpoint.data is None:
            raise await self._lost(id, "it was too large to be recorded")
        try:
            name, definition = await asyncio.to_thread(self._surroundings.surrogate, taken.surrogate_id)
            await asyncio.to_thread(self._surroundings.refresh, taken.surrogate_id)
            saved = Saved(id, name, taken.checkpoint.data)
            await self._inner.restore(Restore(saved, taken.surrogate_id, definition))
        except (Damaged, InvalidInput) as error:
            raise await self._lost(id, str(error)) from error
        except SurrogymError:
            await self._leases.release(id)
            raise

    async def _lost(self, id: str, why: str) -> UnknownSession:
        """End a session that can't be continued, and return the error to raise; ``why`` is the reason in its
        message."""
        await self.close(id)
        return UnknownSession(f"session {id!r} was lost with its session host: {why}; open a new one")

    async def _require_up_to_date(self, id: str) -> None:
        self._leases.require(id)
        if id in self._behind:
            raise await self._lost(id, "it was read before the requests since its last checkpoint came again")

    def _require_still(self, id: str) -> None:
        """Check, after a request, that this process still has the session's lease.

        Raises:
            Unavailable: the lease has expired.
            UnknownSession: the session was closed, or another host has taken it, for example while this process was
                suspended.
        """
        self._leases.require(id)
        if not self._leases.holds(id):
            raise UnknownSession(
                f"session {id!r} was closed, or taken by another host, during this request: send the request "
                "again, or open a new session"
            )

    async def _settle(self) -> None:
        """Delete the database records of sessions that the inner engine has ended."""
        # Wait until no session is being taken over: such a session has a lease but is not in the engine yet, so its
        # record would be deleted.
        async with self._taking:
            await self._leases.remove_all_but([session.id for session in self._inner.sessions()])
            self._behind = {id: seq for id, seq in self._behind.items() if self._leases.holds(id)}
