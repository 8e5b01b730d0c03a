"""Entries of a list of surrogates, read by a few statements for all of them together."""

from __future__ import annotations

import reprlib
from typing import Any

import msgspec
import sqlalchemy as sa
from sqlalchemy.engine import Connection

from surrogym_server.storage.records import LedgerRecord, QueryCounts, SurrogateSummary
from surrogym_server.storage.sql.damage import damaged
from surrogym_server.storage.sql.ledger import ledgers
from surrogym_server.storage.sql.models import newest_of
from surrogym_server.storage.sql.queries import query_counts
from surrogym_server.storage.sql.tables import surrogates

COLUMNS = [
    getattr(surrogates.c, name)
    for name in ("id", "name", "budget", "target", "phase", "paused", "round", "created_at")  # as in the record
]


class _Named(msgspec.Struct):
    """The parsed part of a specification, because parsing all of it takes ten times as long."""

    environment: str = ""


_NAMED = msgspec.json.Decoder(_Named)


def read_summaries(
    connection: Connection, condition: sa.ColumnElement[bool], limit: int | None
) -> list[SurrogateSummary]:
    """Up to ``limit`` surrogates that meet a condition, oldest first. The condition must choose a range of ids."""
    wanted = (
        sa.select(*COLUMNS, sa.type_coerce(surrogates.c.spec, sa.Text))
        .where(condition)
        .order_by(surrogates.c.id)
        .limit(limit)
    )
    rows = connection.execute(wanted).all()
    if not rows:
        return []
    span = (rows[0].id, rows[-1].id)
    spent, queue, newest = ledgers(connection, span), query_counts(connection, span), newest_of(connection, span)
    none_spent, no_queries = LedgerRecord(), QueryCounts()
    summaries = []
    for id, *known, spec in rows:
        counted = (spent.get(id, none_spent), queue.get(id, no_queries), *newest.get(id, (None, None)))
        fields: tuple[Any, ...] = (id, *known, _environment(spec), *counted)
        summaries.append(SurrogateSummary(*fields))
    return summaries


def _environment(spec: str) -> str:
    try:
        return _NAMED.decode(spec).environment
    except msgspec.DecodeError as error:
        raise damaged(f"expected JSON in surrogates.spec, got {reprlib.repr(spec)}: {error}") from error
