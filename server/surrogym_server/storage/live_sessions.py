"""The part of the storage port that records the sessions of a cluster: records, and laws that adapters are tested by.

A session lives in the memory of one process, its owner, which has a lease on it. The database has the session as it was
at its last checkpoint. When the lease has ended, another process may take the session from there.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection
from dataclasses import dataclass, field


@dataclass(frozen=True)
class SessionLease:
    """The right to carry out a session's requests. ``fence`` grows each time that the session changes its owner."""

    id: str
    owner: str
    fence: int


@dataclass(frozen=True)
class Checkpoint:
    """A session as it was after the request ``seq``, as bytes; None where they are more than are recorded."""

    seq: int
    data: bytes | None = field(repr=False)


@dataclass(frozen=True)
class NewLiveSession:
    """A session that was opened. ``key`` is the idempotency key of its opening, ``digest`` that of the opening."""

    id: str
    surrogate_id: int
    machine: str  # the kind of machine that its numbers depend on
    checkpoint: Checkpoint
    key: str | None = None
    digest: str | None = None


@dataclass(frozen=True)
class SessionHolder:
    """Who has a session, and for how many seconds yet; below 0 the lease has ended."""

    owner: str
    seconds_left: float
    machine: str


@dataclass(frozen=True)
class TakenSession:
    """A session with its new lease."""

    lease: SessionLease
    surrogate_id: int
    machine: str
    checkpoint: Checkpoint


class LiveSessions(ABC):
    """Sessions of a cluster, each with one owner at a time.

    Only the owner of the last lease changes a session's row. A lease ends by the database's clock. It may be renewed
    after its end as long as nobody has taken the session. The sessions of a deleted surrogate are removed with it.
    """

    @abstractmethod
    def add(self, new: NewLiveSession, owner: str, seconds: float) -> SessionLease:
        """Record a new session, with a lease of ``seconds`` for its owner.

        Raises:
            UnknownSurrogate: the surrogate was deleted.
            IdempotencyConflict: its id, or the key of its opening, is taken.
        """

    @abstractmethod
    def opened(self, surrogate_id: int, key: str) -> tuple[str, str] | None:
        """Return the id of the session that was opened under a key, and the digest of that opening."""

    @abstractmethod
    def holder(self, id: str) -> SessionHolder | None:
        """Return who has a session; None if there is no such session."""

    @abstractmethod
    def renew(self, owner: str, ids: Collection[str], seconds: float) -> frozenset[str]:
        """Extend an owner's leases of these sessions to ``seconds`` from now, and return the ids of those it has.

        The owner names its sessions, because the database may know of more: the answer to ``add`` or ``take`` may be
        lost with the connection. Nobody steps such a session, so its lease has to end.
        """

    @abstractmethod
    def record(self, lease: SessionLease, checkpoint: Checkpoint) -> bool:
        """Store a checkpoint, and return True. If the lease was replaced, store nothing and return False."""

    @abstractmethod
    def take(self, id: str, owner: str, seconds: float) -> TakenSession:
        """Take over a session whose lease has ended, or the owner's own, with a new lease.

        Raises:
            UnknownSession: there is no such session.
            Unavailable: the lease of another owner has time left; says how much.
        """

    @abstractmethod
    def release(self, lease: SessionLease) -> None:
        """End a lease now. Harmless if it was replaced."""

    @abstractmethod
    def remove(self, id: str) -> None:
        """Remove a session. Harmless if it is not there."""

    @abstractmethod
    def remove_all_of(self, surrogate_id: int) -> None:
        """Remove the sessions of a surrogate."""

    @abstractmethod
    def sweep(self, seconds: float) -> int:
        """Remove sessions whose lease ended more than ``seconds`` ago, and return how many there were.

        A lease with more time left than it was given, because the clock was set back, gets that time from now.
        """
