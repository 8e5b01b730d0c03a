"""Entries of a list of surrogates, read by a few statements for all of them together."""

from __future__ import annotations

import reprlib
from collections.abc import Mapping
from typing import Any

import msgspec
import sqlalchemy as sa
from sqlalchemy.engine import Connection

from surrogym_server.storage.records import LedgerRecord, QueryCounts, SurrogateSummary
from surrogym_server.storage.sql.damage import damaged
from surrogym_server.storage.sql.ledger import ledgers
from surrogym_server.storage.sql.models import newest_of
from surrogym_server.storage.sql.sample_counts import MOST_KEPT, CountedSamples, SampleCounts
from surrogym_server.storage.sql.tables import queries, samples, surrogates

FIELDS = ("id", "name", "budget", "target", "phase", "paused", "round", "error", "created_at")  # read as they are
COLUMNS = [getattr(surrogates.c, name) for name in FIELDS]


ANSWERED = (
    sa.select(queries.c.surrogate_id, sa.func.count())
    .where(queries.c.surrogate_id.in_(sa.bindparam("owners", expanding=True)), queries.c.status == "answered")
    .group_by(queries.c.surrogate_id)
)


class _Named(msgspec.Struct):
    """The only part of a specification that a list needs; parsing all of it takes ten times as long."""

    environment: str = ""


_NAMED = msgspec.json.Decoder(_Named)


UNANSWERED = ("pending", "leased", "set_aside", "refused")  # statuses that an index counts
OPEN_COUNTS = [
    sa.select(sa.func.count())
    .where(queries.c.surrogate_id == surrogates.c.id, queries.c.status == status)
    .scalar_subquery()
    .label(status)
    for status in UNANSWERED
]
NEWEST = sa.select(sa.func.max(samples.c.id)).where(samples.c.surrogate_id == surrogates.c.id).scalar_subquery()
AT_ONCE = 1_000  # most surrogates that one statement reads


class Counted:
    """Numbers of samples and answered queries, kept in memory.

    They change only in a transaction that adds a sample. So the number of answered queries holds as long as the newest
    sample is the same.
    """

    def __init__(self, samples: CountedSamples) -> None:
        self._samples = samples
        self._answered: dict[int, tuple[int | None, int]] = {}  # by surrogate: its newest sample's id, and the number

    def read(self, connection: Connection, newest: Mapping[int, int | None]) -> dict[int, tuple[SampleCounts, int]]:
        """The numbers of each surrogate, given the id of its newest sample, which was read before."""
        counted = self._samples.of_many(connection, newest)
        stale = [id for id in newest if self._answered.get(id, (-1, 0))[0] != newest[id]]
        for first in range(0, len(stale), AT_ONCE):
            self._count(connection, {id: newest[id] for id in stale[first : first + AT_ONCE]})
        return {id: (counted[id], self._answered[id][1]) for id in newest}

    def _count(self, connection: Connection, newest: Mapping[int, int | None]) -> None:
        rows = connection.execute(ANSWERED, {"owners": list(newest)}).all()
        answered = {int(id): int(count) for id, count in rows}
        if len(self._answered) > MOST_KEPT:
            self._answered = {}
        self._answered |= {id: (last, answered.get(id, 0)) for id, last in newest.items()}


def read_summaries(
    connection: Connection, condition: sa.ColumnElement[bool], limit: int | None, counted: Counted
) -> list[SurrogateSummary]:
    """Up to ``limit`` surrogates that meet a condition, oldest first. The condition must choose a range of ids."""
    statement = (
        sa.select(*COLUMNS, sa.type_coerce(surrogates.c.spec, sa.Text), NEWEST, *OPEN_COUNTS)
        .where(condition)
        .order_by(surrogates.c.id)
        .limit(limit)
    )
    rows = connection.execute(statement).all()
    if not rows:
        return []
    span = (rows[0].id, rows[-1].id)
    answers = counted.read(connection, {row.id: row[len(COLUMNS) + 1] for row in rows})
    spent = ledgers(connection, span, {id: counts.by_purpose for id, (counts, _) in answers.items()})
    newest, none_spent = newest_of(connection, span), LedgerRecord()
    summaries = []
    for row in rows:
        id, *values, spec, _ = row[: len(COLUMNS) + 2]
        queue = QueryCounts(answered=answers[id][1], **{status: row._mapping[status] for status in UNANSWERED})
        numbers = (spent.get(id, none_spent), queue, *newest.get(id, (None, None)))
        fields: tuple[Any, ...] = (id, *values, _environment(spec), *numbers)
        summaries.append(SurrogateSummary(*fields))
    return summaries


def _environment(spec: str) -> str:
    try:
        return _NAMED.decode(spec).environment
    except msgspec.DecodeError as error:
        raise damaged(f"expected JSON in surrogates.spec, got {reprlib.repr(spec)}: {error}") from error
