"""Statements that several stores share: find a surrogate, append an event, remember an idempotency key, end leases."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection, Row

from surrogym_server.errors import IdempotencyConflict, UnknownSurrogate
from surrogym_server.storage.sql.database import NOW
from surrogym_server.storage.sql.tables import events, queries, requests, surrogates
from surrogym_shared.nouns import Query
from surrogym_shared.states import EventKind, Purpose

Span = tuple[int, int]  # first and last id of a range of surrogates

# Statements of every answer and claim are built once: SQLAlchemy takes four times as long to build and name one as to
# send it.
NAMED = surrogates.c.name == sa.bindparam("named")
FIND = sa.select(surrogates.c.id).where(NAMED)
LOCKED_COLUMNS = (surrogates.c.id, surrogates.c.phase, surrogates.c.paused, surrogates.c.round, NOW.label("now"))
HOLD = sa.select(*LOCKED_COLUMNS).where(NAMED).with_for_update(key_share=True)
TOUCH = (
    sa.update(surrogates).where(surrogates.c.id == sa.bindparam("touched")).values(revision=surrogates.c.revision + 1)
)
NEW_EVENT, NEW_REQUEST = sa.insert(events), sa.insert(requests)

# A surrogate whose rows are being removed has no name any more; the column holds this word and its id.
REMOVED = "/removed/"  # no name has a slash; the id follows
IS_THERE = surrogates.c.name.not_like(f"{REMOVED}%")
NAMELESS = sa.select(surrogates.c.id).where(~IS_THERE)


def find(connection: Connection, name: str) -> int:
    """Return the id of the surrogate with a name. Raises ``UnknownSurrogate``."""
    row = connection.execute(FIND, {"named": name}).scalar()
    if row is None:
        raise unknown_surrogate(name)
    return int(row)


def hold(connection: Connection, name: str, *extra: sa.ColumnElement[Any]) -> Row[Any]:
    """Lock the surrogate until the transaction ends: (id, phase, paused, round, now, *extra).

    Every writer calls it first, so that writers take turns and events get their ids in order.
    """
    row = connection.execute(HOLD.add_columns(*extra) if extra else HOLD, {"named": name}).one_or_none()
    if row is None:
        raise unknown_surrogate(name)
    return row


def within(table: sa.Table, span: Span) -> sa.ColumnElement[bool]:
    """Whether a row of a table belongs to a surrogate of the span."""
    return table.c.surrogate_id.between(*span)


def unknown_surrogate(name: str) -> UnknownSurrogate:
    return UnknownSurrogate(f"expected the name of a surrogate, got {name!r}, which does not exist")


def append_event(connection: Connection, surrogate: Row[Any], kind: EventKind, **body: Any) -> None:
    connection.execute(
        NEW_EVENT, {"surrogate_id": surrogate.id, "kind": kind, "created_at": surrogate.now, "body": body}
    )


def touch(connection: Connection, surrogate: Row[Any], **changes: Any) -> None:
    """Increase the surrogate's revision, so that its design becomes due, and change other fields."""
    connection.execute(TOUCH.values(**changes) if changes else TOUCH, {"touched": surrogate.id})


def recall(connection: Connection, surrogate: Row[Any], operation: str, key: str | None, body: str) -> Any:
    """Return the earlier result of the operation for this key; None if the key is new.

    Raises:
        IdempotencyConflict: the key was used with another body.
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
    """Store the result of an operation under its idempotency key, for a repeat."""
    if key is not None:
        row = {"surrogate_id": surrogate.id, "operation": operation, "key": key, "fingerprint": body, "result": result}
        connection.execute(NEW_REQUEST, row)


def insert_queries(
    connection: Connection,
    surrogate: Row[Any],
    new_queries: Sequence[Query],
    purpose: Purpose,
    round: int,
    *,
    extra: bool = False,
) -> list[int]:
    """Queue queries, and return their ids in the same order. ``extra`` marks queries that ``improve`` requested, which
    the design alone would not have chosen."""
    if not new_queries:
        return []
    common = {"surrogate_id": surrogate.id, "purpose": purpose, "round": round, "status": "pending", "attempts": 0}
    common["extra"] = extra
    rows = [common | _columns(query) for query in new_queries]
    insert = sa.insert(queries).returning(queries.c.id, sort_by_parameter_order=True)
    ids = [int(id) for id in connection.execute(insert, rows).scalars()]
    append_event(connection, surrogate, "queries", count=len(ids), purpose=purpose, round=round)
    return ids


def _columns(query: Query) -> dict[str, Any]:
    """Convert a query to the columns of its row. Its actions (T, F) become one vector."""
    return {
        "kind": query.kind,
        "coordinates": query.coordinates,
        "action": tuple(chain.from_iterable(query.actions)),
        "steps": query.steps,
        "snapshot": query.snapshot,
    }


def query_in(row: Row[Any]) -> dict[str, Any]:
    """Convert a row with columns ``coordinates``, ``action``, ``steps`` and ``snapshot`` to fields of a ``Query``."""
    size = max(1, len(row.action) // row.steps)
    actions = tuple(row.action[first : first + size] for first in range(0, len(row.action), size))
    return {"coordinates": row.coordinates, "actions": actions, "snapshot": row.snapshot}


# Leases expire by the database's clock alone. Their tables have columns ``expires`` and ``seconds``.

Condition = sa.ColumnElement[bool]  # on a row of a table


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
