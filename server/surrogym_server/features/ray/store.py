"""Storage of the sessions of a cluster: their leases and their last checkpoints.

A session is in the memory of one process, its owner, which has a lease on it. The database has the last checkpoint
of the session. When the lease has expired, another process may continue the session from this checkpoint.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from surrogym_server.errors import IdempotencyConflict, Unavailable, UnknownSession, UnknownSurrogate
from surrogym_server.storage.sql.database import NOW, Database, conflict_insert
from surrogym_server.storage.sql.rows import IS_THERE, has_ended, shorten
from surrogym_server.storage.sql.tables import AT_ONCE, checked, metadata, owner, surrogates


@dataclass(frozen=True)
class SessionLease:
    """Lease of a session, which allows its ``owner`` to carry out requests. ``fence`` is a number that increases with
    each new owner."""

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


live = checked(  # last checkpoint of each session; the session itself is in the memory of its owner
    sa.Table(
        "live_sessions",
        metadata,
        sa.Column("id", sa.Text, primary_key=True),
        owner(),
        sa.Column("key", sa.Text),  # idempotency key of the request that opened the session
        sa.Column("digest", sa.Text),  # content hash of the request that opened the session
        sa.Column("machine", sa.Text, nullable=False),
        sa.Column("owner", sa.Text, nullable=False, index=True),
        sa.Column("fence", sa.BigInteger, nullable=False),
        sa.Column("expires", sa.Double, nullable=False),
        sa.Column("seconds", sa.Double, nullable=False),  # duration of the lease at its last renewal
        sa.Column("seq", sa.BigInteger, nullable=False),
        sa.Column("data", sa.LargeBinary),  # state of the session; NULL: too large
        sa.UniqueConstraint("surrogate_id", "key"),
        info={AT_ONCE: True},
    )
)


class LiveSessions:
    """Storage of the sessions of a cluster, each of which has one owner (a process) at a time.

    Only the owner of the last lease can change a session's row. A lease ends by the database's clock. It may be renewed
    after its end as long as no other process has taken the session. Sessions are removed with their surrogate.
    """

    def __init__(self, database: Database) -> None:
        self._database = database

    def add(self, new: NewLiveSession, owner: str, seconds: float) -> SessionLease:
        """Record a new session, with a lease of ``seconds`` for its owner.

        Raises:
            UnknownSurrogate: the surrogate was deleted.
            IdempotencyConflict: a session with the same id or the same idempotency key exists.
        """
        with self._database.write() as connection:
            _require_surrogate(connection, new.surrogate_id)
            insert = conflict_insert(connection, live).values(
                id=new.id,
                surrogate_id=new.surrogate_id,
                key=new.key,
                digest=new.digest,
                machine=new.machine,
                fence=1,
                seq=new.checkpoint.seq,
                data=new.checkpoint.data,
                **_lease(owner, seconds),
            )
            if connection.execute(insert.on_conflict_do_nothing().returning(live.c.id)).one_or_none() is None:
                raise IdempotencyConflict(
                    f"a session with the id {new.id!r} or with the idempotency key {new.key!r} exists: use a new key"
                )
        return SessionLease(new.id, owner, 1)

    def opened(self, surrogate_id: int, key: str) -> tuple[str, str] | None:
        """Return the id of the session that was opened with an idempotency key, and the content hash of that request;
        None if there is none."""
        with self._database.read() as connection:
            wanted = sa.select(live.c.id, live.c.digest).where(live.c.surrogate_id == surrogate_id, live.c.key == key)
            row = connection.execute(wanted).one_or_none()
        return None if row is None else (row.id, row.digest)

    def holder(self, id: str) -> SessionHolder | None:
        """Return the owner of a session and the time left of its lease; None if there is no such session."""
        with self._database.read() as connection:
            left = (live.c.expires - NOW).label("left")
            row = connection.execute(sa.select(live.c.owner, live.c.machine, left).where(live.c.id == id)).one_or_none()
        return None if row is None else SessionHolder(row.owner, row.left, row.machine)

    def renew(self, owner: str, ids: Collection[str], seconds: float) -> frozenset[str]:
        """Extend an owner's leases of these sessions to ``seconds`` from now. Return the ids of those it still has.

        Sessions that are not in ``ids`` are not renewed, even if the database has them for this owner: the reply to
        ``add`` or ``take`` may have been lost, and then no process runs the session.
        """
        # The ids are in the SQL text, because the number of parameters is limited.
        wanted = sa.bindparam("ids", list(ids), sa.Text(), expanding=True, literal_execute=True)
        with self._database.write() as connection:
            held = sa.update(live).where(live.c.owner == owner, live.c.id.in_(wanted))
            renewed = held.values(_lease(owner, seconds))
            return frozenset(connection.execute(renewed.returning(live.c.id)).scalars())

    def record(self, lease: SessionLease, checkpoint: Checkpoint) -> bool:
        """Store a checkpoint of a leased session. If another process has taken the lease, store nothing and return
        False."""
        # This transaction changes only one row, so it can't deadlock with ``renew``.
        with self._database.write() as connection:
            update = _held(sa.update(live), lease).values(seq=checkpoint.seq, data=checkpoint.data)
            return connection.execute(update).rowcount == 1

    def take(self, id: str, owner: str, seconds: float) -> TakenSession:
        """Give ``owner`` a new lease of a session, and return the session. Its present lease must have expired or
        belong to ``owner``.

        Raises:
            UnknownSession: there is no such session.
            Unavailable: the lease of another owner has not expired; the message has the time left.
        """
        with self._database.write() as connection:
            free = has_ended(live, sa.true()) | (live.c.owner == owner)
            taken = sa.update(live).where(live.c.id == id, free)
            values = {"fence": live.c.fence + 1, **_lease(owner, seconds)}
            row = connection.execute(taken.values(values).returning(*live.c)).one_or_none()
            if row is None:
                left = sa.select((live.c.expires - NOW).label("left")).where(live.c.id == id)
                raise _not_taken(id, connection.execute(left).scalar())
        data = None if row.data is None else bytes(row.data)
        return TakenSession(
            SessionLease(id, owner, row.fence), row.surrogate_id, row.machine, Checkpoint(row.seq, data)
        )

    def release(self, lease: SessionLease) -> None:
        """End the lease of a session now. Does nothing if another process has taken it."""
        with self._database.write() as connection:
            connection.execute(_held(sa.update(live), lease).values(expires=NOW))

    def remove(self, id: str) -> None:
        """Remove the record of a session. Does nothing if it does not exist."""
        with self._database.write() as connection:
            connection.execute(sa.delete(live).where(live.c.id == id))

    def remove_all_of(self, surrogate_id: int) -> None:
        """Remove the records of all sessions of a surrogate, given its id."""
        with self._database.write() as connection:
            connection.execute(sa.delete(live).where(live.c.surrogate_id == surrogate_id))

    def sweep(self, seconds: float) -> int:
        """Remove sessions whose lease expired more than ``seconds`` ago, and return their number.

        A lease with more time left than its duration, because the clock was set back, is shortened to its duration.
        """
        with self._database.write() as connection:
            shorten(connection, live, sa.true())
            forgotten = sa.delete(live).where(live.c.expires <= NOW - seconds)
            return connection.execute(forgotten).rowcount


def _lease(owner: str, seconds: float) -> dict[str, object]:
    return {"owner": owner, "expires": NOW + seconds, "seconds": seconds}


def _held(update: sa.Update, lease: SessionLease) -> sa.Update:
    return update.where(live.c.id == lease.id, live.c.owner == lease.owner, live.c.fence == lease.fence)


def _require_surrogate(connection: Connection, id: int) -> None:
    """Lock the surrogate with this id against deletion until the transaction ends. Raises ``UnknownSurrogate``."""
    wanted = (
        sa.select(surrogates.c.id).where(surrogates.c.id == id, IS_THERE).with_for_update(read=True, key_share=True)
    )
    if connection.execute(wanted).one_or_none() is None:
        raise UnknownSurrogate(f"the surrogate with the id {id} does not exist; it may have just been deleted")


def _not_taken(id: str, seconds_left: float | None) -> UnknownSession | Unavailable:
    if seconds_left is None:
        return UnknownSession(f"no session {id!r}: open a new one")
    return Unavailable(
        f"session {id!r} belongs to another session host for {max(seconds_left, 0.0):.1f} s more: try again later"
    )
