"""Sessions of a cluster: their leases and their last checkpoints."""

from __future__ import annotations

from collections.abc import Collection

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from surrogym_server.errors import IdempotencyConflict, Unavailable, UnknownSession, UnknownSurrogate
from surrogym_server.features.ray.records import (
    Checkpoint,
    NewLiveSession,
    SessionHolder,
    SessionLease,
    TakenSession,
)
from surrogym_server.storage.sql.database import NOW, Database, conflict_insert
from surrogym_server.storage.sql.rows import IS_THERE, has_ended, shorten
from surrogym_server.storage.sql.tables import AT_ONCE, checked, metadata, owner, surrogates

live = checked(  # each is in the memory of its owner, and here as at its last checkpoint
    sa.Table(
        "live_sessions",
        metadata,
        sa.Column("id", sa.Text, primary_key=True),
        owner(),
        sa.Column("key", sa.Text),  # idempotency key of its opening
        sa.Column("digest", sa.Text),  # of the opening
        sa.Column("machine", sa.Text, nullable=False),
        sa.Column("owner", sa.Text, nullable=False, index=True),
        sa.Column("fence", sa.BigInteger, nullable=False),
        sa.Column("expires", sa.Double, nullable=False),
        sa.Column("seconds", sa.Double, nullable=False),  # that the lease was given
        sa.Column("seq", sa.BigInteger, nullable=False),
        sa.Column("data", sa.LargeBinary),  # NULL: too large
        sa.UniqueConstraint("surrogate_id", "key"),
        info={AT_ONCE: True},
    )
)


class LiveSessions:
    """Sessions of a cluster, each with one owner at a time.

    Only the owner of the last lease changes a session's row. A lease ends by the database's clock. It may be renewed
    after its end as long as nobody has taken the session. The sessions of a deleted surrogate are removed with it.
    """

    def __init__(self, database: Database) -> None:
        self._database = database

    def add(self, new: NewLiveSession, owner: str, seconds: float) -> SessionLease:
        """Record a new session, with a lease of ``seconds`` for its owner.

        Raises:
            UnknownSurrogate: the surrogate was deleted.
            IdempotencyConflict: its id, or the key of its opening, is taken.
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
                raise IdempotencyConflict("the id of this session, or the key of its opening, is taken")
        return SessionLease(new.id, owner, 1)

    def opened(self, surrogate_id: int, key: str) -> tuple[str, str] | None:
        """Return the id of the session that was opened under a key, and the digest of that opening."""
        with self._database.read() as connection:
            wanted = sa.select(live.c.id, live.c.digest).where(live.c.surrogate_id == surrogate_id, live.c.key == key)
            row = connection.execute(wanted).one_or_none()
        return None if row is None else (row.id, row.digest)

    def holder(self, id: str) -> SessionHolder | None:
        """Return who has a session; None if there is no such session."""
        with self._database.read() as connection:
            left = (live.c.expires - NOW).label("left")
            row = connection.execute(sa.select(live.c.owner, live.c.machine, left).where(live.c.id == id)).one_or_none()
        return None if row is None else SessionHolder(row.owner, row.left, row.machine)

    def renew(self, owner: str, ids: Collection[str], seconds: float) -> frozenset[str]:
        """Extend an owner's leases of these sessions to ``seconds`` from now, and return the ids of those it has.

        The owner names its sessions, because the database may know of more: the answer to ``add`` or ``take`` may be
        lost with the connection. Nobody steps such a session, so its lease has to end.
        """
        # in the text of the statement, because the number of its parameters is limited
        wanted = sa.bindparam("ids", list(ids), sa.Text(), expanding=True, literal_execute=True)
        with self._database.write() as connection:
            held = sa.update(live).where(live.c.owner == owner, live.c.id.in_(wanted))
            renewed = held.values(_lease(owner, seconds))
            return frozenset(connection.execute(renewed.returning(live.c.id)).scalars())

    def record(self, lease: SessionLease, checkpoint: Checkpoint) -> bool:
        """Store a checkpoint, and return True. If the lease was replaced, store nothing and return False."""
        with self._database.write() as connection:  # of one row; with more, it and ``renew`` could wait for each other
            update = _held(sa.update(live), lease).values(seq=checkpoint.seq, data=checkpoint.data)
            return connection.execute(update).rowcount == 1

    def take(self, id: str, owner: str, seconds: float) -> TakenSession:
        """Take over a session whose lease has ended, or the owner's own, with a new lease.

        Raises:
            UnknownSession: there is no such session.
            Unavailable: the lease of another owner has time left; says how much.
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
        """End a lease now. Harmless if it was replaced."""
        with self._database.write() as connection:
            connection.execute(_held(sa.update(live), lease).values(expires=NOW))

    def remove(self, id: str) -> None:
        """Remove a session. Harmless if it is not there."""
        with self._database.write() as connection:
            connection.execute(sa.delete(live).where(live.c.id == id))

    def remove_all_of(self, surrogate_id: int) -> None:
        """Remove the sessions of a surrogate."""
        with self._database.write() as connection:
            connection.execute(sa.delete(live).where(live.c.surrogate_id == surrogate_id))

    def sweep(self, seconds: float) -> int:
        """Remove sessions whose lease ended more than ``seconds`` ago, and return how many there were.

        A lease with more time left than it was given, because the clock was set back, gets that time from now.
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
    """Keep the surrogate from being deleted until the transaction ends. Raises ``UnknownSurrogate``."""
    wanted = (
        sa.select(surrogates.c.id).where(surrogates.c.id == id, IS_THERE).with_for_update(read=True, key_share=True)
    )
    if connection.execute(wanted).one_or_none() is None:
        raise UnknownSurrogate(f"expected the id of a surrogate, got {id}, which is not there")


def _not_taken(id: str, seconds_left: float | None) -> UnknownSession | Unavailable:
    if seconds_left is None:
        return UnknownSession(f"no session {id!r}: open a new one")
    return Unavailable(
        f"session {id!r} belongs to another session host for {max(seconds_left, 0.0):.1f} s more: try again later"
    )
