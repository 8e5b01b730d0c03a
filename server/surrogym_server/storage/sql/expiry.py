"""Expiry of leases, by the database's clock alone, for every table with columns ``expires`` and ``seconds``."""

from __future__ import annotations

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from surrogym_server.storage.sql.database import NOW

Condition = sa.ColumnElement[bool]  # on a row of the table


def has_ended(table: sa.Table, is_leased: Condition) -> sa.ColumnElement[bool]:
    """Whether a lease has expired."""
    return is_leased & (table.c.expires <= NOW)


def is_too_long(table: sa.Table, is_leased: Condition) -> sa.ColumnElement[bool]:
    """Whether a lease has more time left than it began with, because the database's clock was set back."""
    return is_leased & (table.c.expires > NOW + table.c.seconds)


def shorten(connection: Connection, table: sa.Table, is_leased: Condition) -> None:
    """Shorten leases that are too long to their original duration from now, so that live callers keep their leases."""
    too_long = sa.update(table).where(is_too_long(table, is_leased))
    connection.execute(too_long.values(expires=NOW + table.c.seconds))
