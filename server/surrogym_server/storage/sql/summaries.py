"""Entries of a list of surrogates, read by a few statements for all of them together."""

from __future__ import annotations

import reprlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import msgspec
import sqlalchemy as sa
from sqlalchemy.engine import Connection

from surrogym_server.storage.records import LedgerRecord, QueryCounts, SurrogateSummary
from surrogym_server.storage.sql.damage import damaged
from surrogym_server.storage.sql.ledger import ledgers, samples_by_purpose
from surrogym_server.storage.sql.models import newest_of
from surrogym_server.storage.sql.tables import queries, samples, surrogates

COLUMNS = [
    getattr(surrogates.c, name)
    for name in ("id", "name", "budget", "target", "phase", "paused", "round", "created_at")  # as in the record
]


class _Named(msgspec.Struct):
    """The parsed part of a specification, because parsing all of it takes ten times as long."""

    environment: str = ""


_NAMED = msgspec.json.Decoder(_Named)


UNANSWERED = ("pending", "leased", "set_aside")  # statuses of queries; a look into the index counts each
OPEN_COUNTS = [
    sa.select(sa.func.count())
    .where(queries.c.surrogate_id == surrogates.c.id, queries.c.status == status)
    .scalar_subquery()
    .label(status)
    for status in UNANSWERED
]
NEWEST = sa.select(sa.func.max(samples.c.id)).where(samples.c.surrogate_id == surrogates.c.id).scalar_subquery()
MOST_KEPT = 100_000  # surrogates
AT_ONCE = 1_000  # surrogates of one statement


@dataclass(frozen=True)
class _Counts:
    """What is counted of a surrogate's answers. ``newest`` is the id of the last sample before they were counted."""

    newest: int | None
    samples: Mapping[str, int]  # by purpose
    answered: int  # queries


class Counted:
    """Numbers of samples and answered queries, kept in memory, because counting a million rows takes 0.3 s.

    They change only in a transaction that adds a sample. Samples of a surrogate are added one transaction after the
    other, are never changed, and go only with their surrogate. So the numbers hold as long as the newest sample is the
    same. Other processes may add samples too.
    """

    def __init__(self) -> None:
        self._known: dict[int, _Counts] = {}

    def read(self, connection: Connection, newest: Mapping[int, int | None]) -> dict[int, _Counts]:
        """The numbers of each surrogate, given the id of its newest sample, which was read before."""
        known = {id: self._known.get(id) for id in newest}
        stale = [id for id, counts in known.items() if counts is None or counts.newest != newest[id]]
        found = {id: counts for id, counts in known.items() if counts is not None}
        for first in range(0, len(stale), AT_ONCE):
            found |= _counted(connection, {id: newest[id] for id in stale[first : first + AT_ONCE]})
        if len(self._known) > MOST_KEPT:
            self._known = {}
        self._known |= found
        return found


def _counted(connection: Connection, newest: Mapping[int, int | None]) -> dict[int, _Counts]:
    by_purpose = samples_by_purpose(connection, samples.c.surrogate_id.in_(newest))
    wanted = sa.select(queries.c.surrogate_id, sa.func.count()).where(
        queries.c.surrogate_id.in_(newest), queries.c.status == "answered"
    )
    rows = connection.execute(wanted.group_by(queries.c.surrogate_id)).all()
    answered = {int(id): int(count) for id, count in rows}
    return {id: _Counts(last, by_purpose.get(id, {}), answered.get(id, 0)) for id, last in newest.items()}


def read_summaries(
    connection: Connection, condition: sa.ColumnElement[bool], limit: int | None, counted: Counted
) -> list[SurrogateSummary]:
    """Up to ``limit`` surrogates that meet a condition, oldest first. The condition must choose a range of ids."""
    wanted = (
        sa.select(*COLUMNS, sa.type_coerce(surrogates.c.spec, sa.Text), NEWEST, *OPEN_COUNTS)
        .where(condition)
        .order_by(surrogates.c.id)
        .limit(limit)
    )
    rows = connection.execute(wanted).all()
    if not rows:
        return []
    span = (rows[0].id, rows[-1].id)
    answers = counted.read(connection, {row.id: row[len(COLUMNS) + 1] for row in rows})
    spent = ledgers(connection, span, {id: counts.samples for id, counts in answers.items()})
    newest, none_spent = newest_of(connection, span), LedgerRecord()
    summaries = []
    for row in rows:
        id, *known, spec, _ = row[: len(COLUMNS) + 2]
        queue = QueryCounts(answered=answers[id].answered, **{status: row._mapping[status] for status in UNANSWERED})
        numbers = (spent.get(id, none_spent), queue, *newest.get(id, (None, None)))
        fields: tuple[Any, ...] = (id, *known, _environment(spec), *numbers)
        summaries.append(SurrogateSummary(*fields))
    return summaries


def _environment(spec: str) -> str:
    try:
        return _NAMED.decode(spec).environment
    except msgspec.DecodeError as error:
        raise damaged(f"expected JSON in surrogates.spec, got {reprlib.repr(spec)}: {error}") from error
