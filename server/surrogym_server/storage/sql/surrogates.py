"""Adapter of ``Surrogates``: surrogates by name."""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection, Row

from surrogym_server.errors import UnknownSurrogate
from surrogym_server.storage import port
from surrogym_server.storage.records import FREE, NewSurrogate, Standing, SurrogateRecord, SurrogateSummary
from surrogym_server.storage.sql import initial, removal
from surrogym_server.storage.sql.database import NOW, Database, conflict_insert
from surrogym_server.storage.sql.leases import is_unbegun, requeue_set_aside
from surrogym_server.storage.sql.rows import NAMED, append_event, hold, touch, unknown_surrogate
from surrogym_server.storage.sql.sample_counts import CountedSamples
from surrogym_server.storage.sql.summaries import Counted, read_summaries
from surrogym_server.storage.sql.tables import queries, samples, surrogates
from surrogym_shared.states import Phase

COLUMNS = [
    getattr(surrogates.c, name)
    for name in (
        *("id", "name", "spec", "budget", "target", "tolerances", "phase", "paused", "round", "state", "error"),
        *("extra_queries", "checkpoint", "created_at"),
    )
]
READ = sa.select(*COLUMNS).where(NAMED)
STANDING = sa.select(surrogates.c.id, surrogates.c.phase, surrogates.c.paused).where(NAMED)


class SqlSurrogates(port.Surrogates):
    def __init__(self, database: Database, counted: CountedSamples) -> None:
        self._database = database
        self._counted = Counted(counted)

    def create(self, new: NewSurrogate) -> tuple[SurrogateRecord, bool]:
        with self._database.write() as connection:
            if not _insert(connection, new):
                return read(connection, new.name), False
            surrogate = hold(connection, new.name)
            append_event(connection, surrogate, "created", name=new.name)
            initial.begin(connection, surrogate, new.queries)
        initial.ask(self._database, new.name, new.queries)
        return self.get(new.name), True

    def get(self, name: str) -> SurrogateRecord:
        with self._database.read() as connection:
            return read(connection, name)

    def standing(self, name: str) -> Standing:
        with self._database.read() as connection:
            row = connection.execute(STANDING, {"named": name}).one_or_none()
        if row is None:
            raise unknown_surrogate(name)
        return Standing(*row)

    def name_of(self, id: int) -> str:
        with self._database.read() as connection:
            named = sa.select(surrogates.c.name).where(surrogates.c.id == id, removal.IS_THERE)
            name = connection.execute(named).scalar()
        if name is None:
            raise UnknownSurrogate("expected an existing surrogate, got one that was deleted")
        return str(name)

    def summary(self, name: str) -> SurrogateSummary:
        with self._database.read() as connection:
            summaries = read_summaries(connection, surrogates.c.name == name, 1, self._counted)
        if not summaries:
            raise unknown_surrogate(name)
        return summaries[0]

    def summaries(self, after: int = 0, limit: int | None = None) -> list[SurrogateSummary]:
        with self._database.read() as connection:
            return read_summaries(connection, (surrogates.c.id > after) & removal.IS_THERE, limit, self._counted)

    def change(
        self,
        name: str,
        *,
        paused: bool | None = None,
        budget: int | None = None,
        target: float | None = None,
        tolerances: dict[str, float | None] | None = None,
    ) -> SurrogateRecord:
        with self._database.write() as connection:
            surrogate = hold(connection, name)
            before = read(connection, name)
            merged = None if tolerances is None else _set_or_taken_back(before.tolerances, tolerances)
            fields = {"paused": paused, "budget": budget, "target": target, "tolerances": merged}
            changes: dict[str, Any] = {
                field: value for field, value in fields.items() if value is not None and value != getattr(before, field)
            }
            if paused is False and before.phase == "failed":
                changes |= {"phase": resting_phase(before.round), "error": None}
            again = requeue_set_aside(connection, surrogate) if paused is False else 0
            if not changes and not again:
                return before
            smaller = budget if budget is not None and budget < before.budget else None
            if smaller is not None:
                initial.end(connection, surrogate)
            if smaller is not None or changes.keys() & {"target", "tolerances"}:
                changes |= _withdraw_unbegun(connection, surrogate, before, smaller)
            if changes:
                _apply(connection, surrogate, changes)
            requeued = {"asked_again": again} if again else {}
            append_event(connection, surrogate, "phase", **{"phase": before.phase, **changes, **requeued})
            return read(connection, name)

    def set_phase(self, name: str, phase: Phase, error: str | None = None) -> None:
        with self._database.write() as connection:
            surrogate = hold(connection, name)
            update_phase(connection, surrogate, phase, error)

    def delete(self, name: str) -> None:
        with self._database.write() as connection:
            id = removal.take_name(connection, name)
        removal.remove(self._database, id)

    def complete_removals(self) -> int:
        with self._database.read() as connection:
            ids = removal.interrupted(connection)
        for id in ids:
            removal.remove(self._database, id)
        return len(ids)


def read(connection: Connection, name: str) -> SurrogateRecord:
    row = connection.execute(READ, {"named": name}).one_or_none()
    if row is None:
        raise unknown_surrogate(name)
    return _record(row)


def update_phase(connection: Connection, surrogate: Row[Any], phase: Phase, error: str | None) -> None:
    update = sa.update(surrogates).where(surrogates.c.id == surrogate.id)
    connection.execute(update.values(phase=phase, error=error))
    append_event(connection, surrogate, "phase", phase=phase, error=error)


def resting_phase(round: int) -> Phase:
    """The phase of a design that waits for samples."""
    return "sampling" if round else "collecting"


def _record(row: Row[Any]) -> SurrogateRecord:
    return SurrogateRecord(**row._mapping)


def _insert(connection: Connection, new: NewSurrogate) -> bool:
    """Insert a surrogate, and return whether the name was free."""
    insert = conflict_insert(connection, surrogates).values(
        name=new.name,
        spec=new.spec,
        budget=new.budget,
        target=new.target,
        state={},
        phase="collecting",
        paused=False,
        round=0,
        extra_queries=0,
        revision=0,
        fitted_revision=0,
        created_at=NOW,
    )
    free = insert.on_conflict_do_nothing(index_elements=["name"]).returning(surrogates.c.id)
    return connection.execute(free).scalar() is not None


def _set_or_taken_back(before: dict[str, float], changes: dict[str, float | None]) -> dict[str, float]:
    others = {name: value for name, value in before.items() if name not in changes}
    return others | {name: value for name, value in changes.items() if value is not None}


def _withdraw_unbegun(
    connection: Connection, surrogate: Row[Any], before: SurrogateRecord, budget: int | None
) -> dict[str, Any]:
    """Withdraw what a design planned for another target, tolerance or budget.

    This is the right of a running fit, and the queries that no sampler has begun.

    Steps that ``improve`` requested are requested again, unless the new ``budget`` is smaller. Initial queries beyond a
    smaller budget are withdrawn too. Returns the fields of the surrogate that change.
    """
    unbegun = is_unbegun(surrogate.id)
    statement = sa.delete(queries).where(unbegun, queries.c.purpose == "adaptive")
    withdrawn = connection.execute(statement.returning(queries.c.steps, queries.c.extra)).all()
    connection.execute(sa.update(surrogates).where(surrogates.c.id == surrogate.id).values(**removal.NO_RIGHT))
    changes = {"phase": resting_phase(surrogate.round)} if surrogate.phase == "fitting" else {}
    if budget is None:
        again = sum(row.steps for row in withdrawn if row.extra)
        return {**changes, "extra_queries": before.extra_queries + again} if again else changes
    initial = sa.select(queries.c.id, queries.c.steps).where(unbegun, queries.c.purpose == "initial")
    beyond, gone = spoken_for(connection, surrogate.id) - budget, []
    for row in connection.execute(initial.order_by(queries.c.id.desc())):
        if beyond < row.steps:
            break
        beyond -= row.steps
        gone.append(row.id)
    connection.execute(sa.delete(queries).where(queries.c.id.in_(gone)))
    return changes


def spoken_for(connection: Connection, surrogate_id: int) -> int:
    """Number of real steps that count towards the budget: samples, and the steps of unanswered queries.

    Queries that were set aside count, because steps may have been taken; refused ones don't.
    """
    sampled = sa.select(sa.func.count()).where(samples.c.surrogate_id == surrogate_id, samples.c.purpose.not_in(FREE))
    awaited = sa.select(sa.func.coalesce(sa.func.sum(queries.c.steps), 0)).where(
        queries.c.surrogate_id == surrogate_id,
        queries.c.status.not_in(("answered", "refused")),
        queries.c.purpose.not_in(FREE),
    )
    return int(connection.execute(sa.select(sampled.scalar_subquery() + awaited.scalar_subquery())).scalar_one())


def _apply(connection: Connection, surrogate: Row[Any], changes: dict[str, Any]) -> None:
    if changes.keys() - {"paused"}:
        touch(connection, surrogate, **changes)
    else:
        connection.execute(sa.update(surrogates).where(surrogates.c.id == surrogate.id).values(**changes))
