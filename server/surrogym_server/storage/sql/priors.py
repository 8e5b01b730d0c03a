"""Implementation of ``Priors``: at most one prior model for each surrogate."""

from __future__ import annotations

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from surrogym_server.storage import port
from surrogym_server.storage.records import JSON, PriorRecord
from surrogym_server.storage.sql import surrogates as stored
from surrogym_server.storage.sql.database import Database, conflict_insert, damaged
from surrogym_server.storage.sql.rows import append_event, checksum, find, hold, touch
from surrogym_server.storage.sql.tables import priors


class SqlPriors(port.Priors):
    def __init__(self, database: Database) -> None:
        self._database = database

    def get(self, name: str) -> PriorRecord | None:
        with self._database.read() as connection:
            row = connection.execute(
                sa.select(priors.c.created_at, priors.c.about, priors.c.blob.is_(None).label("awaited")).where(
                    priors.c.surrogate_id == find(connection, name)
                )
            ).one_or_none()
        return None if row is None else PriorRecord(row.created_at, row.about, awaited=bool(row.awaited))

    def blob(self, name: str) -> bytes | None:
        with self._database.read() as connection:
            own = priors.c.surrogate_id == find(connection, name)
            row = connection.execute(sa.select(priors.c.blob, priors.c.checksum).where(own)).one_or_none()
        if row is None or row.blob is None:
            return None
        if checksum(row.blob) != row.checksum:
            raise damaged(
                f"the prior of {name!r} has changed since it was stored, as its checksum shows: store the prior again"
            )
        return bytes(row.blob)

    def put(self, name: str, blob: bytes, about: JSON) -> None:
        with self._database.write() as connection:
            self._store(connection, name, blob, about)

    def wait(self, name: str) -> None:
        with self._database.write() as connection:
            own = priors.c.surrogate_id == hold(connection, name).id
            if connection.execute(sa.select(priors.c.surrogate_id).where(own)).first() is None:
                self._store(connection, name, None, {})

    def drop(self, name: str) -> bool:
        with self._database.write() as connection:
            surrogate = hold(connection, name)
            own = priors.c.surrogate_id == surrogate.id
            if not connection.execute(sa.delete(priors).where(own)).rowcount:
                return False
            _plan_anew(connection, name)
            return True

    def _store(self, connection: Connection, name: str, blob: bytes | None, about: JSON) -> None:
        surrogate = hold(connection, name)
        columns = {"created_at": surrogate.now, "about": about, "blob": blob, "checksum": checksum(blob or b"")}
        insert = conflict_insert(connection, priors).values(surrogate_id=surrogate.id, **columns)
        connection.execute(insert.on_conflict_do_update(index_elements=["surrogate_id"], set_=columns))
        if blob is not None:
            _plan_anew(connection, name)


def _plan_anew(connection: Connection, name: str) -> None:
    """Withdraw queries that were chosen with another prior and without a real step so far, and make a fit due."""
    surrogate, before = hold(connection, name), stored.read(connection, name)
    touch(connection, surrogate, **stored.withdraw_unbegun(connection, surrogate, before, None))
    append_event(connection, surrogate, "phase", phase=before.phase, error=before.error)
