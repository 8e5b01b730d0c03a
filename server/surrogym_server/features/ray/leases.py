"""Leases and checkpoints of the sessions of one process. Methods must be called in the event loop's thread."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, field

from surrogym_server.engine.session import Session, session_to_bytes
from surrogym_server.errors import SurrogymError, Unavailable
from surrogym_server.features.ray.store import Checkpoint, LiveSessions, NewLiveSession, SessionLease, TakenSession

logger = logging.getLogger(__name__)

MAX_BYTES = 16 * 2**20  # largest checkpoint in bytes; a session with a larger state has no checkpoints
# Largest rate at which checkpoints of one session are written: a session with a large state gets fewer checkpoints.
BYTES_PER_SECOND = 8 * 2**20
RENEWALS = 5  # number of renewals within the duration of a lease


def seconds_now() -> float:
    """Return the time in seconds, by a clock that also runs while the machine sleeps, if the system has one."""
    return time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))


@dataclass(frozen=True)
class Pace:
    """Time between two checkpoints of a session, and duration of a lease, in seconds."""

    checkpoint_seconds: float = 1.0
    lease_seconds: float = 10.0


@dataclass
class _Held:
    lease: SessionLease
    until: float  # end of the lease by this process's clock, not later than by the database's clock
    seq: int  # the session's sequence number at the last checkpoint
    next_at: float  # earliest time of the next checkpoint, by this process's clock
    # Whether the last checkpoint has the session's state; False if it was too large.
    recorded: bool = field(default=True)


class Leases:
    """The leases and checkpoints of this process's sessions.

    For this process, a lease begins before the SQL statement that renews it. So it ends here no later than in the
    database. Before a step, the end of the lease is only compared with a clock, without asking the database.

    Args:
        store: records of the sessions in the database.
        owner: unique name of this process.
        machine: kind of this machine, on which the last bits of a step depend.
        pace: time between checkpoints, and duration of leases.
        drop: ends the session with this id, after another process has taken its lease.
        clock: returns the time in seconds.
    """

    def __init__(
        self,
        store: LiveSessions,
        owner: str,
        machine: str,
        pace: Pace,
        drop: Callable[[str], None],
        clock: Callable[[], float] = seconds_now,
    ) -> None:
        self.machine = machine
        self._store = store
        self._owner = owner
        self._pace = pace
        self._drop = drop
        self._clock = clock
        self._held: dict[str, _Held] = {}

    def holds(self, id: str) -> bool:
        return id in self._held

    def require(self, id: str) -> None:
        """Raise ``Unavailable`` if this process has the session, but its lease has expired."""
        held = self._held.get(id)
        if held is not None and self._clock() >= held.until:
            raise Unavailable(f"the lease of session {id!r} has ended, and is not renewed yet: try again later")

    async def add(self, session: Session, surrogate_id: int) -> None:
        """Record a new session in the database, under a lease of this process. Raises the errors of
        ``LiveSessions.add``."""
        key, digest = session.opened_by or (None, None)
        checkpoint = await asyncio.to_thread(_checkpoint, session)
        new = NewLiveSession(session.id, surrogate_id, self.machine, checkpoint, key, digest)
        began = self._clock()
        lease = await asyncio.to_thread(self._store.add, new, self._owner, self._pace.lease_seconds)
        self._keep(lease, began, checkpoint)

    async def take(self, id: str) -> TakenSession:
        """Take over a session from another process, and return it. Raises the errors of ``LiveSessions.take``."""
        began = self._clock()
        taken = await asyncio.to_thread(self._store.take, id, self._owner, self._pace.lease_seconds)
        self._keep(taken.lease, began, taken.checkpoint)
        return taken

    async def release(self, id: str) -> None:
        """End the lease of a session now, so that another process can take it."""
        if held := self._held.pop(id, None):
            await asyncio.to_thread(self._store.release, held.lease)

    async def remove(self, id: str) -> None:
        """Delete the record of a session in the database. If that fails, ``remove_all_but`` will repeat it."""
        await asyncio.to_thread(self._store.remove, id)
        self._held.pop(id, None)

    async def remove_all_but(self, alive: Sequence[str]) -> None:
        """Delete the database records of this process's sessions, except those with an id in ``alive``."""
        for id in self._held.keys() - set(alive):
            await self.remove(id)

    async def renew(self) -> None:
        """Renew all leases of this process, and end the sessions that another process has taken."""
        before, began = dict(self._held), self._clock()
        if not before:
            return
        kept = await asyncio.to_thread(self._store.renew, self._owner, before.keys(), self._pace.lease_seconds)
        for id, held in before.items():
            if id in kept:
                held.until = began + self._pace.lease_seconds
            elif self._held.get(id) is held:
                del self._held[id]
                self._drop(id)
                logger.warning("session %s was taken by another host, or was removed", id)

    async def record(self, sessions: Sequence[Session]) -> None:
        """Write checkpoints of those sessions that have changed since their last checkpoint."""
        for session in sessions:
            held = self._held.get(session.id)
            if held is None or session.seq == held.seq or self._clock() < held.next_at:
                continue
            checkpoint = await asyncio.to_thread(_checkpoint, session)
            if held.recorded or checkpoint.data is not None:
                await asyncio.to_thread(self._store.record, held.lease, checkpoint)
            _note(held, checkpoint, self._clock(), self._pace.checkpoint_seconds)

    async def keep_renewing(self) -> None:
        """Renew all leases periodically, until cancelled."""
        while True:
            await _tried(self.renew())
            await asyncio.sleep(self._pace.lease_seconds / RENEWALS)

    async def keep_recording(self, sessions: Callable[[], Sequence[Session]]) -> None:
        """Write checkpoints of all sessions periodically, until cancelled."""
        while True:
            await asyncio.sleep(self._pace.checkpoint_seconds)
            alive = sessions()
            await _tried(self.record(alive))

    def _keep(self, lease: SessionLease, began: float, checkpoint: Checkpoint) -> None:
        held = _Held(lease, began + self._pace.lease_seconds, checkpoint.seq, began)
        _note(held, checkpoint, began, 0.0)
        self._held[lease.id] = held


def _note(held: _Held, checkpoint: Checkpoint, now: float, seconds: float) -> None:
    held.seq, held.recorded = checkpoint.seq, checkpoint.data is not None
    held.next_at = now + max(seconds, len(checkpoint.data or b"") / BYTES_PER_SECOND)


def _checkpoint(session: Session) -> Checkpoint:
    """Return a checkpoint of a session. Its data is None if it would exceed ``MAX_BYTES``."""
    if session.nbytes > MAX_BYTES:
        return Checkpoint(session.seq, None)
    data = session_to_bytes(session)
    return Checkpoint(session.seq, data if len(data) <= MAX_BYTES else None)


async def _tried(work: Awaitable[None]) -> None:
    try:
        await work
    except SurrogymError as error:
        logger.warning("leases or checkpoints of sessions could not be written, the next try follows: %s", error)
    except Exception:  # an error must not end the periodic renewal; while a lease is expired, steps are refused
        logger.exception("leases or checkpoints of sessions could not be written; the next try follows")
