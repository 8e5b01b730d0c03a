"""Real steps by purpose, counted from the stored samples and leases."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from surrogym_server.storage import port
from surrogym_server.storage.records import LedgerRecord, fingerprint
from surrogym_server.storage.sql.database import NOW, Database, constant
from surrogym_server.storage.sql.rows import Span, append_event, find, hold, recall, remember
from surrogym_server.storage.sql.sample_counts import CountedSamples
from surrogym_server.storage.sql.tables import evaluations, leases, queries, surrogates

OPERATION = "report_steps"


BOUNDS: tuple[sa.BindParameter[int], sa.BindParameter[int]] = (sa.bindparam("first"), sa.bindparam("last"))


def _evaluations() -> sa.Select[Any]:
    summed = sa.select(
        evaluations.c.surrogate_id,
        constant("evaluation"),
        sa.type_coerce(sa.func.sum(evaluations.c.steps), sa.Integer()),
    )
    return summed.where(evaluations.c.surrogate_id.between(*BOUNDS)).group_by(evaluations.c.surrogate_id)


def _unresolved() -> sa.Select[Any]:
    """Select the steps of leases that failed or expired, also of those that are still marked as open.

    The conditions use an index, so that leases with an answer, which are nearly all, are not read.
    """
    failed, expired, is_open = constant("failed"), constant("expired"), constant("open")
    unswept = (leases.c.outcome == is_open) & (leases.c.expires <= NOW)
    ended = leases.c.outcome.in_((failed, expired, is_open)) & ((leases.c.outcome != is_open) | unswept)
    how = sa.case((leases.c.outcome == failed, failed), else_=expired).label("how")
    summed = sa.select(leases.c.surrogate_id, how, sa.type_coerce(sa.func.sum(queries.c.steps), sa.Integer()))
    own = summed.join_from(surrogates, leases, leases.c.surrogate_id == surrogates.c.id)
    joined = own.join(queries, queries.c.id == leases.c.query_id)
    return joined.where(surrogates.c.id.between(*BOUNDS), ended).group_by(leases.c.surrogate_id, how)


OTHERS = sa.union_all(_evaluations(), _unresolved())


class SqlLedger(port.Ledger):
    def __init__(self, database: Database, counted: CountedSamples) -> None:
        self._database = database
        self._counted = counted

    def report(self, name: str, steps: int, *, key: str, episodes: int = 0, note: str = "") -> LedgerRecord:
        body = fingerprint(steps, episodes, note)
        fields = {"steps": steps, "episodes": episodes, "note": note}
        with self._database.write() as connection:
            surrogate = hold(connection, name)
            if recall(connection, surrogate, OPERATION, key, body) is None:
                row = sa.insert(evaluations).values(surrogate_id=surrogate.id, created_at=surrogate.now, **fields)
                connection.execute(row)
                append_event(connection, surrogate, "ledger", purpose="evaluation", **fields)
                remember(connection, surrogate, OPERATION, key, body, True)
            return self._read(connection, surrogate.id)

    def read(self, name: str) -> LedgerRecord:
        with self._database.read() as connection:
            return self._read(connection, find(connection, name))

    def _read(self, connection: Connection, surrogate_id: int) -> LedgerRecord:
        sampled = {surrogate_id: self._counted.of(connection, surrogate_id).by_purpose}
        return ledgers(connection, (surrogate_id, surrogate_id), sampled)[surrogate_id]


def ledgers(connection: Connection, span: Span, sampled: Mapping[int, Mapping[str, int]]) -> dict[int, LedgerRecord]:
    """The ledger of each surrogate of the span that has any steps.

    Args:
        span: ids of surrogates.
        sampled: number of samples by surrogate and purpose.
    """
    rows = connection.execute(OTHERS, {"first": span[0], "last": span[1]}).all()
    counted: defaultdict[int, dict[str, int]] = defaultdict(dict)
    for surrogate, counts in sampled.items():
        counted[surrogate].update(counts)
    for surrogate, what, steps in rows:
        counted[surrogate][what] = int(steps)
    return {surrogate: _record(**counts) for surrogate, counts in counted.items()}


def _record(*, failed: int = 0, expired: int = 0, **steps: int) -> LedgerRecord:
    return LedgerRecord(**steps, unresolved=failed + expired, failed=failed)
