"""Records of the sessions of a cluster.

A session is in the memory of one process, its owner, which has a lease on it. The database has the last checkpoint of
the session. When the lease has expired, another process may continue the session from this checkpoint.
"""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class SessionLease:
    """Lease of a session, which allows its ``owner`` to carry out requests. ``fence`` increases with each new owner."""

    id: str
    owner: str
    fence: int


@dataclass(frozen=True)
class Checkpoint:
    """State of a session after the request with the sequence number ``seq``. ``data`` is this state as bytes; None if
    it is too large to store."""

    seq: int
    data: bytes | None = field(repr=False)


@dataclass(frozen=True)
class NewLiveSession:
    """A new session to record. ``key`` is the idempotency key of the request that opened it, and ``digest`` the
    request's content hash."""

    id: str
    surrogate_id: int
    machine: str  # kind of machine, on which the last bits of the session's numbers depend
    checkpoint: Checkpoint
    key: str | None = None
    digest: str | None = None


@dataclass(frozen=True)
class SessionHolder:
    """Owner of a session, and the time left of its lease in seconds; negative if the lease has expired."""

    owner: str
    seconds_left: float
    machine: str


@dataclass(frozen=True)
class TakenSession:
    """A session that was taken over, with its new lease and its last checkpoint."""

    lease: SessionLease
    surrogate_id: int
    machine: str
    checkpoint: Checkpoint
