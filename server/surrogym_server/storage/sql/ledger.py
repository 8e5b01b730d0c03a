"""Real steps by purpose, counted from the stored samples and leases."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from surrogym_server.storage import port
from surrogym_server.storage.records import LedgerRecord, fingerprint
from surrogym_server.storage.sql.damage import damaged
from surrogym_server.storage.sql.database import Database, clock
from surrogym_server.storage.sql.rows import Span, append_event, find, hold, recall, remember, within
from surrogym_server.storage.sql.tables import evaluations, leases, queries, samples, surrogates

OPERATION = "report_steps"
COUNTED = ("initial", "adaptive", "manual", "audit", "logged", "evaluation", "failed", "expired")


class SqlLedger(port.Ledger):
    def __init__(self, database: Database) -> None:
        self._database = database

    def report(self, name: str, steps: int, *, key: str, episodes: int = 0, note: str = "") -> LedgerRecord:
        body = fingerprint(steps, episodes, note)
        told = {"steps": steps, "episodes": episodes, "note": note}
        with self._database.write() as connection:
            held = hold(connection, name)
            if recall(connection, held, OPERATION, key, body) is None:
                row = sa.insert(evaluations).values(surrogate_id=held.id, created_at=held.now, **told)
                connection.execute(row)
                append_event(connection, held, "ledger", purpose="evaluation", **told)
                remember(connection, held, OPERATION, key, body, True)
            return _read(connection, held.id)

    def read(self, name: str) -> LedgerRecord:
        with self._database.read() as connection:
            return _read(connection, find(connection, name))


def ledgers(
    connection: Connection, span: Span, sampled: Mapping[int, Mapping[str, int]] | None = None
) -> dict[int, LedgerRecord]:
    """The ledger of each surrogate of the span that has any steps.

    Args:
        span: ids of surrogates.
        sampled: number of samples by surrogate and purpose, if the caller has counted them.
    """
    parts = [_evaluations_of(span), _unresolved_of(connection, span)]
    rows = connection.execute(sa.union_all(*parts)).all()
    sampled = samples_by_purpose(connection, within(samples, span)) if sampled is None else sampled
    counted: defaultdict[int, dict[str, int]] = defaultdict(dict)
    for surrogate, counts in sampled.items():
        counted[surrogate].update(counts)
    for surrogate, what, steps in rows:
        counted[surrogate][what] = int(steps)
    return {surrogate: _record(**counts) for surrogate, counts in counted.items()}


def samples_by_purpose(connection: Connection, condition: sa.ColumnElement[bool]) -> dict[int, dict[str, int]]:
    """Number of samples that meet a condition, by surrogate and purpose."""
    counted: defaultdict[int, dict[str, int]] = defaultdict(dict)
    for surrogate, what, steps in connection.execute(_samples_of(condition)).all():
        if what not in COUNTED:
            raise damaged(f"expected one of {list(COUNTED)} in samples.purpose, got {what!r}")
        counted[surrogate][what] = int(steps)
    return dict(counted)


def _read(connection: Connection, surrogate_id: int) -> LedgerRecord:
    return ledgers(connection, (surrogate_id, surrogate_id)).get(surrogate_id, LedgerRecord())


def _record(*, failed: int = 0, expired: int = 0, **steps: int) -> LedgerRecord:
    return LedgerRecord(**steps, unresolved=failed + expired, failed=failed)


def _samples_of(condition: sa.ColumnElement[bool]) -> sa.Select[Any]:
    purpose = sa.type_coerce(samples.c.purpose, sa.Text)  # its own type would refuse the words of other tables
    counted = sa.select(samples.c.surrogate_id, purpose, sa.func.count())
    return counted.where(condition).group_by(samples.c.surrogate_id, samples.c.purpose)


def _evaluations_of(span: Span) -> sa.Select[Any]:
    evaluation = sa.literal_column("'evaluation'", sa.Text)
    summed = sa.select(
        evaluations.c.surrogate_id, evaluation, sa.type_coerce(sa.func.sum(evaluations.c.steps), sa.Integer())
    )
    return summed.where(within(evaluations, span)).group_by(evaluations.c.surrogate_id)


def _unresolved_of(connection: Connection, span: Span) -> sa.Select[Any]:
    """Steps of leases that failed or expired, whether swept or not. An index leads to them past those with an
    answer."""
    unswept = (leases.c.outcome == "open") & (leases.c.expires <= clock(connection))
    ended = leases.c.outcome.in_(("failed", "expired", "open")) & ((leases.c.outcome != "open") | unswept)
    how = sa.case((leases.c.outcome == "failed", "failed"), else_="expired").label("how")
    summed = sa.select(leases.c.surrogate_id, how, sa.type_coerce(sa.func.sum(queries.c.steps), sa.Integer()))
    own = summed.join_from(surrogates, leases, leases.c.surrogate_id == surrogates.c.id)
    joined = own.join(queries, queries.c.id == leases.c.query_id)
    return joined.where(surrogates.c.id.between(*span), ended).group_by(leases.c.surrogate_id, how)
