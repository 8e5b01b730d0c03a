"""Leases and checkpoints of the sessions of one process. Call all methods in the event loop's thread."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, field

from surrogym_server.engine.saved import session_to_bytes
from surrogym_server.engine.session import Session
from surrogym_server.errors import SurrogymError, Unavailable
from surrogym_server.features.ray.records import Checkpoint, NewLiveSession, SessionLease, TakenSession
from surrogym_server.features.ray.store import LiveSessions

logger = logging.getLogger(__name__)

MAX_BYTES = 16 * 2**20  # largest checkpoint; the state of a larger session is not recorded
BYTES_PER_SECOND = 8 * 2**20  # highest rate at which checkpoints of one session are written
RENEWALS = 5  # number of renewals within the time of a lease


def seconds_now() -> float:
    """Return seconds of a clock that also runs while the machine sleeps, if it has such a clock."""
    return time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))


@dataclass(frozen=True)
class Pace:
    """How often checkpoints of a session are written, and how long a lease lasts."""

    checkpoint_seconds: float = 1.0
    lease_seconds: float = 10.0


@dataclass
class _Held:
    lease: SessionLease
    until: float  # by this process's clock; not later than the lease's end by the database's
    seq: int  # of the last checkpoint
    next_at: float  # when the next one may be made
    recorded: bool = field(default=True)  # False: the last one had no bytes


class Leases:
    """Leases of the sessions that one owner, a process, holds.

    The time of a lease counts from before the statement that renews it. So a lease ends here no later than in the
    database. A step only compares the end with a clock, and does not ask the database.

    Args:
        store: the database.
        owner: a name that no other process has or had.
        machine: kind of this machine; the last bits of a step depend on it.
        pace: how often to write checkpoints, and how long leases last.
        drop: called with the id of a session whose lease another owner has; it ends the session here.
        clock: returns seconds.
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
        """Raise ``Unavailable`` if this owner holds a session whose lease has ended."""
        held = self._held.get(id)
        if held is not None and self._clock() >= held.until:
            raise Unavailable(f"the lease of session {id!r} has ended, and is not renewed yet: try again later")

    async def add(self, session: Session, surrogate_id: int) -> None:
        """Record a new session, under a lease of this owner. Raises like ``LiveSessions.add``."""
        key, digest = session.opened_by or (None, None)
        checkpoint = await asyncio.to_thread(_checkpoint, session)
        new = NewLiveSession(session.id, surrogate_id, self.machine, checkpoint, key, digest)
        began = self._clock()
        lease = await asyncio.to_thread(self._store.add, new, self._owner, self._pace.lease_seconds)
        self._keep(lease, began, checkpoint)

    async def take(self, id: str) -> TakenSession:
        """Take over the lease of a session. Raises like ``LiveSessions.take``."""
        began = self._clock()
        taken = await asyncio.to_thread(self._store.take, id, self._owner, self._pace.lease_seconds)
        self._keep(taken.lease, began, taken.checkpoint)
        return taken

    async def release(self, id: str) -> None:
        """End the lease of a session now, so that another owner can take it."""
        if held := self._held.pop(id, None):
            await asyncio.to_thread(self._store.release, held.lease)

    async def remove(self, id: str) -> None:
        """Delete the record of a session. If that fails, ``remove_all_but`` tries again."""
        await asyncio.to_thread(self._store.remove, id)
        self._held.pop(id, None)

    async def remove_all_but(self, alive: Sequence[str]) -> None:
        """Delete the records of this owner's sessions whose ids are not in ``alive``."""
        for id in self._held.keys() - set(alive):
            await self.remove(id)

    async def renew(self) -> None:
        """Renew all leases, and drop the sessions that another owner has."""
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
        """Write checkpoints of the sessions that have changed since their last one."""
        for session in sessions:
            held = self._held.get(session.id)
            if held is None or session.seq == held.seq or self._clock() < held.next_at:
                continue
            checkpoint = await asyncio.to_thread(_checkpoint, session)
            if held.recorded or checkpoint.data is not None:
                await asyncio.to_thread(self._store.record, held.lease, checkpoint)
            _note(held, checkpoint, self._clock(), self._pace.checkpoint_seconds)

    async def keep_renewing(self) -> None:
        """Renew all leases again and again, until cancelled."""
        while True:
            await _tried(self.renew())
            await asyncio.sleep(self._pace.lease_seconds / RENEWALS)

    async def keep_recording(self, sessions: Callable[[], Sequence[Session]]) -> None:
        """Write checkpoints again and again, until cancelled."""
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
    """Make a checkpoint of a session. Its data is None if it would exceed ``MAX_BYTES``, which is estimated first."""
    if session.nbytes > MAX_BYTES:
        return Checkpoint(session.seq, None)
    data = session_to_bytes(session)
    return Checkpoint(session.seq, data if len(data) <= MAX_BYTES else None)


async def _tried(work: Awaitable[None]) -> None:
    try:
        await work
    except SurrogymError as error:
        logger.warning("leases or checkpoints of sessions could not be written, the next try follows: %s", error)
    except Exception:  # a lease that ends refuses steps; it must not end the loop
        logger.exception("leases or checkpoints of sessions could not be written; the next try follows")
