"""Real steps by purpose, counted from what is stored."""

from __future__ import annotations

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from surrogym_server.storage import port
from surrogym_server.storage.records import LedgerRecord, fingerprint
from surrogym_server.storage.sql.database import Database, clock
from surrogym_server.storage.sql.rows import append_event, find, hold, recall, remember
from surrogym_server.storage.sql.tables import evaluations, leases, queries, samples

OPERATION = "report_steps"


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


def _read(connection: Connection, surrogate_id: int) -> LedgerRecord:
    purposes = ("initial", "adaptive", "manual")
    counts = [sa.func.count().filter(samples.c.purpose == purpose).label(purpose) for purpose in purposes]
    evaluation = sa.select(sa.func.coalesce(sa.func.sum(evaluations.c.steps), 0)).where(
        evaluations.c.surrogate_id == surrogate_id
    )
    failed = leases.c.outcome == "failed"
    expired = (leases.c.outcome == "expired") | (
        (leases.c.outcome == "open") & (leases.c.expires <= clock(connection))  # not swept yet
    )
    row = connection.execute(
        sa.select(
            *counts,
            evaluation.scalar_subquery().label("evaluation"),
            _steps_asked(surrogate_id, expired | failed).label("unresolved"),
            _steps_asked(surrogate_id, failed).label("failed"),
        ).where(samples.c.surrogate_id == surrogate_id)
    ).one()
    return LedgerRecord(**{field: int(value) for field, value in row._mapping.items()})


def _steps_asked(surrogate_id: int, of_leases: sa.ColumnElement[bool]) -> sa.ScalarSelect[int]:
    """Steps that such leases of a surrogate were given out for."""
    return (
        sa.select(sa.func.coalesce(sa.func.sum(queries.c.steps), 0))
        .select_from(leases.join(queries, queries.c.id == leases.c.query_id))
        .where(leases.c.surrogate_id == surrogate_id, of_leases)
        .scalar_subquery()
    )
