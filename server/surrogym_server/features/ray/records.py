"""Records of the sessions of a cluster.

A session lives in the memory of one process, its owner, which has a lease on it. The database has the session as it was
at its last checkpoint. When the lease has ended, another process may take the session from there.
"""

from __future__ import annotations

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
