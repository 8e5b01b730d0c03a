"""Removal of a surrogate: its name is taken away at once, and its rows go in transactions that block nobody for long.

A surrogate without a name is one that is being removed. A removal that a crash has interrupted is completed later.
"""

from __future__ import annotations

from functools import partial

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from surrogym_server.storage.sql.database import BATCH, Database
from surrogym_server.storage.sql.rows import hold
from surrogym_server.storage.sql.tables import metadata, models, policies, surrogates

REMOVED = "/removed/"  # no name has a slash; the id follows
IS_THERE = surrogates.c.name.not_like(f"{REMOVED}%")
NAMELESS = sa.select(surrogates.c.id).where(~IS_THERE)
LARGE = {models: 8, policies: 8}  # tables whose rows have many bytes, or further rows
AT_ONCE = "at once"  # mark in the ``info`` of tables whose rows are removed together with the surrogate's name
NO_RIGHT = {"fit_token": None, "fit_owner": None, "fit_expires": None, "fit_seconds": None}


def take_name(connection: Connection, name: str) -> int:
    """Take the name from a surrogate, so that nobody finds it, and return its id. Raises ``UnknownSurrogate``."""
    id = int(hold(connection, name).id)
    for table in metadata.tables.values():
        if AT_ONCE in table.info:
            connection.execute(sa.delete(table).where(table.c.surrogate_id == id))
    gone = {"name": f"{REMOVED}{id}", "paused": True, **NO_RIGHT}
    connection.execute(sa.update(surrogates).where(surrogates.c.id == id).values(**gone))
    return id


def interrupted(connection: Connection) -> list[int]:
    """Ids of the surrogates whose removal is not complete: they have no name any more."""
    return [*connection.execute(NAMELESS).scalars()]


def remove(database: Database, id: int) -> None:
    """Remove a surrogate that has no name any more, with its rows. A repeat is harmless."""
    for table in reversed(metadata.sorted_tables):  # rows before those that they refer to
        if "surrogate_id" in table.c:
            database.write_in_batches(partial(_remove_some, table, id))
    with database.write() as connection:
        connection.execute(sa.delete(surrogates).where(surrogates.c.id == id, ~IS_THERE))


def _remove_some(table: sa.Table, id: int, connection: Connection) -> int:
    key = sa.tuple_(*table.primary_key.columns)
    some = sa.select(*table.primary_key.columns).where(table.c.surrogate_id == id).limit(LARGE.get(table, BATCH))
    return connection.execute(sa.delete(table).where(key.in_(some))).rowcount
