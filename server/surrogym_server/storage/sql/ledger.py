"""Implementation of ``Ledger``: counts of real steps by purpose, from the stored samples and leases.

The counts of samples are cached in memory, because counting a million rows takes 0.3 s.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from surrogym_server.storage import port
from surrogym_server.storage.records import LedgerRecord, fingerprint
from surrogym_server.storage.sql.database import NOW, Database, constant, damaged
from surrogym_server.storage.sql.rows import Span, append_event, find, hold, recall, remember
from surrogym_server.storage.sql.tables import evaluations, leases, queries, samples, surrogates

COUNTED = ("initial", "adaptive", "manual", "audit", "logged", "evaluation", "failed", "expired")
MOST_KEPT = 100_000  # largest number of surrogates whose numbers of samples are cached

PURPOSE = sa.type_coerce(samples.c.purpose, sa.Text)  # read as text, because the column's type refuses unknown words
BY_PURPOSE: sa.Select[Any] = sa.select(
    samples.c.surrogate_id, PURPOSE, sa.func.count(), sa.func.max(samples.c.id)
).group_by(samples.c.surrogate_id, samples.c.purpose)
# Largest number of surrogates in one statement, because SQLite limits the depth of an expression to 1,000.
COUNTED_AT_ONCE = 500
SINCE = BY_PURPOSE.where(samples.c.surrogate_id == sa.bindparam("owner"), samples.c.id > sa.bindparam("newest"))


@dataclass(frozen=True)
class SampleCounts:
    """Numbers of a surrogate's samples by purpose, up to the sample with the id ``newest``."""

    newest: int = 0
    by_purpose: Mapping[str, int] = field(default_factory=dict)


NONE = SampleCounts()


class CountedSamples:
    """Cache of the numbers of samples of each surrogate. A call counts only the samples added since the last call.

    This works because the ids of a surrogate's samples increase, and because samples are never changed, and only
    deleted with their surrogate. Other processes may add samples too.
    """

    def __init__(self) -> None:
        self._counts: dict[int, SampleCounts] = {}

    def of(self, connection: Connection, surrogate_id: int) -> SampleCounts:
        earlier = self._counts.get(surrogate_id, NONE)
        since = connection.execute(SINCE, {"owner": surrogate_id, "newest": earlier.newest})
        return self._add(surrogate_id, earlier, since)

    def of_many(self, connection: Connection, newest: Mapping[int, int | None]) -> dict[int, SampleCounts]:
        """Return the counts of several surrogates by a few SQL statements.

        ``newest`` has the id of each surrogate's newest sample, by surrogate id.
        """
        earlier = {id: self._counts.get(id, NONE) for id in newest}
        stale = [id for id, last in newest.items() if earlier[id].newest < (last or 0)]
        for first in range(0, len(stale), COUNTED_AT_ONCE):
            some = {id: earlier[id] for id in stale[first : first + COUNTED_AT_ONCE]}
            earlier |= self._count(connection, some)
        return earlier

    def _count(self, connection: Connection, earlier: Mapping[int, SampleCounts]) -> dict[int, SampleCounts]:
        since = [_is_since(id, counts) for id, counts in earlier.items() if counts.newest]
        new = samples.c.surrogate_id.in_([id for id, counts in earlier.items() if not counts.newest])
        rows: defaultdict[int, list[Sequence[Any]]] = defaultdict(list)
        for row in connection.execute(BY_PURPOSE.where(sa.or_(new, *since))):
            rows[row[0]].append(row)
        return {id: self._add(id, counts, rows[id]) for id, counts in earlier.items()}

    def _add(self, surrogate_id: int, earlier: SampleCounts, since: Iterable[Sequence[Any]]) -> SampleCounts:
        newest, by_purpose = earlier.newest, dict(earlier.by_purpose)
        for _, purpose, count, last in since:
            if purpose not in COUNTED:
                raise damaged(
                    f"expected one of {list(COUNTED)} in samples.purpose, got {purpose!r}; restore a copy of "
                    "the database"
                )
            by_purpose[purpose] = by_purpose.get(purpose, 0) + int(count)
            newest = max(newest, int(last))
        if len(self._counts) > MOST_KEPT:
            self._counts = {}
        counts = self._counts[surrogate_id] = SampleCounts(newest, by_purpose)
        return counts


def _is_since(surrogate_id: int, counts: SampleCounts) -> sa.ColumnElement[bool]:
    return (samples.c.surrogate_id == surrogate_id) & (samples.c.id > counts.newest)


REPORT = "report_steps"


BOUNDS: tuple[sa.BindParameter[int], sa.BindParameter[int]] = (sa.bindparam("first"), sa.bindparam("last"))


def _evaluations() -> sa.Select[Any]:
    summed = sa.select(
        evaluations.c.surrogate_id,
        constant("evaluation"),
        sa.type_coerce(sa.func.sum(evaluations.c.steps), sa.Integer()),
    )
    return summed.where(evaluations.c.surrogate_id.between(*BOUNDS)).group_by(evaluations.c.surrogate_id)


def _unresolved() -> sa.Select[Any]:
    """Return the SELECT of the numbers of steps under leases that failed or expired, by surrogate and outcome.

    Expired leases that are still marked as open count too. The conditions use an index, so that answered leases are not
    read; nearly all leases are answered.
    """
    failed, expired, is_open = constant("failed"), constant("expired"), constant("open")
    unswept = (leases.c.outcome == is_open) & (leases.c.expires <= NOW)
    has_no_answer = leases.c.outcome.in_((failed, expired, is_open)) & ((leases.c.outcome != is_open) | unswept)
    how = sa.case((leases.c.outcome == failed, failed), else_=expired).label("how")
    summed = sa.select(leases.c.surrogate_id, how, sa.type_coerce(sa.func.sum(queries.c.steps), sa.Integer()))
    own = summed.join_from(surrogates, leases, leases.c.surrogate_id == surrogates.c.id)
    join = own.join(queries, queries.c.id == leases.c.query_id)
    return join.where(surrogates.c.id.between(*BOUNDS), has_no_answer).group_by(leases.c.surrogate_id, how)


OTHERS = sa.union_all(_evaluations(), _unresolved())


class SqlLedger(port.Ledger):
    def __init__(self, database: Database, counts: CountedSamples) -> None:
        self._database = database
        self._counted = counts

    def report(self, name: str, steps: int, *, key: str, episodes: int = 0, note: str = "") -> LedgerRecord:
        body = fingerprint(steps, episodes, note)
        fields = {"steps": steps, "episodes": episodes, "note": note}
        with self._database.write() as connection:
            surrogate = hold(connection, name)
            if recall(connection, surrogate, REPORT, key, body) is None:
                row = sa.insert(evaluations).values(surrogate_id=surrogate.id, created_at=surrogate.now, **fields)
                connection.execute(row)
                append_event(connection, surrogate, "ledger", purpose="evaluation", **fields)
                remember(connection, surrogate, REPORT, key, body, True)
            return self._read(connection, surrogate.id)

    def read(self, name: str) -> LedgerRecord:
        with self._database.read() as connection:
            return self._read(connection, find(connection, name))

    def _read(self, connection: Connection, surrogate_id: int) -> LedgerRecord:
        sampled = {surrogate_id: self._counted.of(connection, surrogate_id).by_purpose}
        return ledgers(connection, (surrogate_id, surrogate_id), sampled)[surrogate_id]


def ledgers(connection: Connection, span: Span, sampled: Mapping[int, Mapping[str, int]]) -> dict[int, LedgerRecord]:
    """Return the counts of real steps of the surrogates in a range of ids, by id. Surrogates without real steps are
    left out.

    Args:
        connection: connection to the database.
        span: first and last id of the surrogates.
        sampled: numbers of samples by surrogate id and purpose.
    """
    rows = connection.execute(OTHERS, {"first": span[0], "last": span[1]}).all()
    of_surrogates: defaultdict[int, dict[str, int]] = defaultdict(dict)
    for surrogate, counts in sampled.items():
        of_surrogates[surrogate].update(counts)
    for surrogate, what, steps in rows:
        of_surrogates[surrogate][what] = int(steps)
    return {surrogate: _record(**counts) for surrogate, counts in of_surrogates.items()}


def _record(*, failed: int = 0, expired: int = 0, **steps: int) -> LedgerRecord:
    return LedgerRecord(**steps, unresolved=failed + expired, failed=failed)
