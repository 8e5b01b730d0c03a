"""SQL statements that several stores share, on surrogates, events, idempotency keys, queries and leases."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection, Row

from surrogym_server.errors import IdempotencyConflict, UnknownSurrogate
from surrogym_server.storage.sql.database import NOW, Database
from surrogym_server.storage.sql.tables import events, requests, surrogates
from surrogym_shared.states import EventKind

Span = tuple[int, int]  # first and last id of a range of surrogates

# Statements of frequent requests are built once, because SQLAlchemy takes four times as long to build one as to send
# it.
NAMED = surrogates.c.name == sa.bindparam("named")
FIND = sa.select(surrogates.c.id).where(NAMED)
LOCKED_COLUMNS = (surrogates.c.id, surrogates.c.phase, surrogates.c.paused, surrogates.c.round, NOW.label("now"))
HOLD = sa.select(*LOCKED_COLUMNS).where(NAMED).with_for_update(key_share=True)
TOUCH = (
    sa.update(surrogates).where(surrogates.c.id == sa.bindparam("touched")).values(revision=surrogates.c.revision + 1)
)
NEW_EVENT, NEW_REQUEST = sa.insert(events), sa.insert(requests)

# While the rows of a deleted surrogate are removed, its name is replaced by this prefix and its id.
REMOVED = "/removed/"  # differs from all names, which have no slash
IS_THERE = surrogates.c.name.not_like(f"{REMOVED}%")
NAMELESS = sa.select(surrogates.c.id).where(~IS_THERE)


def find(connection: Connection, name: str) -> int:
    """Return the id of the surrogate with this name. Raises ``UnknownSurrogate``."""
    row = connection.execute(FIND, {"named": name}).scalar()
    if row is None:
        raise unknown_surrogate(name)
    return int(row)


def hold(connection: Connection, name: str, *extra: sa.ColumnElement[Any]) -> Row[Any]:
    """Lock a surrogate until the transaction ends. Return the columns (id, phase, paused, round, now, *extra).

    Each transaction that writes to a surrogate calls this first, so that such transactions run one after the other and
    events get their ids in order.
    """
    row = connection.execute(HOLD.add_columns(*extra) if extra else HOLD, {"named": name}).one_or_none()
    if row is None:
        raise unknown_surrogate(name)
    return row


def set_columns(connection: Connection, surrogate: int, **values: Any) -> None:
    """Set columns of the surrogate with the id ``surrogate``."""
    connection.execute(sa.update(surrogates).where(surrogates.c.id == surrogate).values(**values))


def within(table: sa.Table, span: Span) -> sa.ColumnElement[bool]:
    """Return the SQL condition that a row of a table belongs to a surrogate in a range of ids."""
    return table.c.surrogate_id.between(*span)


def checksum(blob: bytes) -> str:
    """Return the SHA-256 of stored content, by which damage is found."""
    return hashlib.sha256(blob).hexdigest()


def unknown_surrogate(name: str) -> UnknownSurrogate:
    return UnknownSurrogate(f"expected the name of a surrogate, got {name!r}, which does not exist")


def append_event(connection: Connection, surrogate: Row[Any], kind: EventKind, **body: Any) -> None:
    connection.execute(
        NEW_EVENT, {"surrogate_id": surrogate.id, "kind": kind, "created_at": surrogate.now, "body": body}
    )


def touch(connection: Connection, surrogate: Row[Any], **changes: Any) -> None:
    """Increase a surrogate's revision, so that a fit becomes due, and change the given other columns."""
    connection.execute(TOUCH.values(**changes) if changes else TOUCH, {"touched": surrogate.id})


def recall(connection: Connection, surrogate: Row[Any], operation: str, key: str | None, body: str) -> Any:
    """Return the result of an earlier request with the same operation and idempotency key; None if the key is new.

    Raises:
        IdempotencyConflict: the earlier request had another content hash than ``body``.
    """
    if key is None:
        return None
    row = connection.execute(
        sa.select(requests.c.fingerprint, requests.c.result)
        .where(requests.c.surrogate_id == surrogate.id, requests.c.operation == operation)
        .where(requests.c.key == key)
    ).one_or_none()
    if row is None:
        return None
    if row.fingerprint != body:
        raise IdempotencyConflict(
            f"expected the same body as in the first request with the idempotency key {key!r}, got another: use a "
            "new key"
        )
    return row.result


def remember(
    connection: Connection, surrogate: Row[Any], operation: str, key: str | None, body: str, result: Any
) -> None:
    """Store the result of an operation under its idempotency key, so that a repeat gets it. ``body`` is the request's
    content hash."""
    if key is not None:
        row = {"surrogate_id": surrogate.id, "operation": operation, "key": key, "fingerprint": body, "result": result}
        connection.execute(NEW_REQUEST, row)


# The functions below work for any table of leases with the columns ``expires`` and ``seconds``, by the database's
# clock.

Condition = sa.ColumnElement[bool]  # SQL condition on a row of a table


def has_ended(table: sa.Table, is_leased: Condition) -> sa.ColumnElement[bool]:
    """Return the SQL condition that a row of a table holds a lease (``is_leased``) which has expired."""
    return is_leased & (table.c.expires <= NOW)


def is_too_long(table: sa.Table, is_leased: Condition) -> sa.ColumnElement[bool]:
    """Return the SQL condition that a row holds a lease (``is_leased``) with more time left than its duration, because
    the database's clock was set back."""
    return is_leased & (table.c.expires > NOW + table.c.seconds)


def shorten(connection: Connection, table: sa.Table, is_leased: Condition) -> None:
    """Shorten the leases of a table that have more time left than their duration, because the clock was set back, to
    their duration from now."""
    too_long = sa.update(table).where(is_too_long(table, is_leased))
    connection.execute(too_long.values(expires=NOW + table.c.seconds))


def sweep_table(
    database: Database, table: sa.Table, is_leased: Condition, sweep: Callable[[Connection, Row[Any]], int]
) -> int:
    """End the expired leases of a table for all surrogates, and return their number. ``sweep`` ends those of one
    surrogate, which is locked. Leases that are too long, because the clock was set back, are shortened."""
    with database.read() as connection:
        owners = sa.select(table.c.surrogate_id).where(has_ended(table, is_leased)).distinct()
        statement = sa.select(surrogates.c.name).where(surrogates.c.id.in_(owners))
        names = list(connection.execute(statement).scalars())
        set_back = connection.execute(sa.select(sa.exists().where(is_too_long(table, is_leased)))).scalar()
    if set_back:
        with database.write() as connection:
            shorten(connection, table, is_leased)
    ended = 0
    for name in names:
        with suppress(UnknownSurrogate), database.write() as connection:  # the surrogate may just have been deleted
            ended += sweep(connection, hold(connection, name))
    return ended
