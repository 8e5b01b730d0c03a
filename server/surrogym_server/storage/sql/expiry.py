"""End of a lease, by the database's clock alone. Shared by all tables whose rows have ``expires`` and ``seconds``."""

from __future__ import annotations

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from surrogym_server.storage.sql.database import NOW

Held = sa.ColumnElement[bool]  # whether a row of the table is leased


def has_ended(table: sa.Table, surrogate: Held) -> sa.ColumnElement[bool]:
    """Whether a lease has expired."""
    return surrogate & (table.c.expires <= NOW)


def is_too_long(table: sa.Table, surrogate: Held) -> sa.ColumnElement[bool]:
    """Whether a lease has more time left than it was given, because the clock was set back since."""
    return surrogate & (table.c.expires > NOW + table.c.seconds)


def shorten(connection: Connection, table: sa.Table, surrogate: Held) -> None:
    """Limit the time left of leases that are too long to the time that they were given, so that a live caller keeps its
    own."""
    too_long = sa.update(table).where(is_too_long(table, surrogate))
    connection.execute(too_long.values(expires=NOW + table.c.seconds))
