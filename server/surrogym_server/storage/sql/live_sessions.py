"""Sessions of a cluster: their leases and their last checkpoints."""

from __future__ import annotations

from collections.abc import Collection

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from surrogym_server.errors import IdempotencyConflict, Unavailable, UnknownSession, UnknownSurrogate
from surrogym_server.storage.live_sessions import (
    Checkpoint,
    LiveSessions,
    NewLiveSession,
    SessionHolder,
    SessionLease,
    TakenSession,
)
from surrogym_server.storage.sql.database import NOW, Database, conflict_insert
from surrogym_server.storage.sql.expiry import has_ended, shorten
from surrogym_server.storage.sql.removal import IS_THERE
from surrogym_server.storage.sql.tables import live_sessions as live
from surrogym_server.storage.sql.tables import surrogates


class SqlLiveSessions(LiveSessions):
    def __init__(self, database: Database) -> None:
        self._database = database

    def add(self, new: NewLiveSession, owner: str, seconds: float) -> SessionLease:
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
        with self._database.read() as connection:
            wanted = sa.select(live.c.id, live.c.digest).where(live.c.surrogate_id == surrogate_id, live.c.key == key)
            row = connection.execute(wanted).one_or_none()
        return None if row is None else (row.id, row.digest)

    def holder(self, id: str) -> SessionHolder | None:
        with self._database.read() as connection:
            left = (live.c.expires - NOW).label("left")
            row = connection.execute(sa.select(live.c.owner, live.c.machine, left).where(live.c.id == id)).one_or_none()
        return None if row is None else SessionHolder(row.owner, row.left, row.machine)

    def renew(self, owner: str, ids: Collection[str], seconds: float) -> frozenset[str]:
        # in the text of the statement, because the number of its parameters is limited
        wanted = sa.bindparam("ids", list(ids), sa.Text(), expanding=True, literal_execute=True)
        with self._database.write() as connection:
            held = sa.update(live).where(live.c.owner == owner, live.c.id.in_(wanted))
            renewed = held.values(_lease(owner, seconds))
            return frozenset(connection.execute(renewed.returning(live.c.id)).scalars())

    def record(self, lease: SessionLease, checkpoint: Checkpoint) -> bool:
        """One row in a transaction: with more, this could wait for ``renew`` while that waits for this."""
        with self._database.write() as connection:
            update = _held(sa.update(live), lease).values(seq=checkpoint.seq, data=checkpoint.data)
            return connection.execute(update).rowcount == 1

    def take(self, id: str, owner: str, seconds: float) -> TakenSession:
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
        with self._database.write() as connection:
            connection.execute(_held(sa.update(live), lease).values(expires=NOW))

    def remove(self, id: str) -> None:
        with self._database.write() as connection:
            connection.execute(sa.delete(live).where(live.c.id == id))

    def remove_all_of(self, surrogate_id: int) -> None:
        with self._database.write() as connection:
            connection.execute(sa.delete(live).where(live.c.surrogate_id == surrogate_id))

    def sweep(self, seconds: float) -> int:
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
