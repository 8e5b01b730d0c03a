"""Surrogates by name, summaries for their list, and their deletion.

A deletion first replaces the name, so that the surrogate is not found any more, and then removes its rows in several
short transactions. A deletion that a crash has interrupted is completed later.
"""

from __future__ import annotations

import reprlib
from collections.abc import Mapping
from functools import partial
from typing import Any

import msgspec
import sqlalchemy as sa
from sqlalchemy.engine import Connection, Row

from surrogym_server.errors import UnknownSurrogate
from surrogym_server.storage.records import (
    LedgerRecord,
    NewSurrogate,
    QueryCounts,
    Standing,
    SurrogateRecord,
    SurrogateSummary,
)
from surrogym_server.storage.sql.database import BATCH, NOW, Database, conflict_insert, damaged
from surrogym_server.storage.sql.models import newest_of
from surrogym_server.storage.sql.queries import (
    begin_initial,
    end_initial,
    is_unbegun,
    queue_initial,
    requeue_set_aside,
    spoken_for,
)
from surrogym_server.storage.sql.rows import (
    IS_THERE,
    NAMED,
    NAMELESS,
    REMOVED,
    append_event,
    hold,
    set_columns,
    touch,
    unknown_surrogate,
)
from surrogym_server.storage.sql.samples import MOST_KEPT, CountedSamples, SampleCounts, ledgers
from surrogym_server.storage.sql.tables import metadata, models, policies, queries, samples, surrogates
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


class Surrogates:
    """The storage of surrogates, which are identified by name."""

    def __init__(self, database: Database, counts: CountedSamples) -> None:
        self._database = database
        self._counted = Counted(counts)

    def create(self, new: NewSurrogate) -> tuple[SurrogateRecord, bool]:
        """Create a surrogate in phase ``collecting`` with its initial queries. Return it, and whether it is new.

        Many queries are queued in several transactions, so that other writers wait only briefly. No fit is due before
        all are queued. If a crash interrupts the call, ``Designs.unbegun`` returns the surrogate, and
        ``Designs.ask_first`` queues the missing queries.

        If a surrogate of this name exists, it is returned unchanged, with False. The caller has to compare the
        specifications.
        """
        with self._database.write() as connection:
            if not _insert(connection, new):
                return read(connection, new.name), False
            surrogate = hold(connection, new.name)
            append_event(connection, surrogate, "created", name=new.name)
            begin_initial(connection, surrogate, new.queries)
        queue_initial(self._database, new.name, new.queries)
        return self.get(new.name), True

    def get(self, name: str) -> SurrogateRecord:
        with self._database.read() as connection:
            return read(connection, name)

    def standing(self, name: str) -> Standing:
        """Return the fields of a surrogate that frequent requests read: its id, its phase, and whether it is paused.
        Raises ``UnknownSurrogate``."""
        with self._database.read() as connection:
            row = connection.execute(STANDING, {"named": name}).one_or_none()
        if row is None:
            raise unknown_surrogate(name)
        return Standing(*row)

    def name_of(self, id: int) -> str:
        """Return the name of a surrogate by its id. Raises ``UnknownSurrogate`` if it was deleted."""
        with self._database.read() as connection:
            statement = sa.select(surrogates.c.name).where(surrogates.c.id == id, IS_THERE)
            name = connection.execute(statement).scalar()
        if name is None:
            raise UnknownSurrogate(f"the surrogate with the id {id} does not exist any more: it was deleted")
        return str(name)

    def summary(self, name: str) -> SurrogateSummary:
        with self._database.read() as connection:
            summaries = read_summaries(connection, surrogates.c.name == name, 1, self._counted)
        if not summaries:
            raise unknown_surrogate(name)
        return summaries[0]

    def summaries(self, after: int = 0, limit: int | None = None) -> list[SurrogateSummary]:
        """Return summaries of up to ``limit`` surrogates with an id above ``after``, oldest first.

        The number of SQL statements does not depend on the number of surrogates. No model is loaded, and only the
        environment's name is parsed from a specification.
        """
        with self._database.read() as connection:
            return read_summaries(connection, (surrogates.c.id > after) & IS_THERE, limit, self._counted)

    def change(
        self,
        name: str,
        *,
        paused: bool | None = None,
        budget: int | None = None,
        target: float | None = None,
        tolerances: dict[str, float | None] | None = None,
    ) -> SurrogateRecord:
        """Change the fields of a surrogate that are given (not None), and return its record.

        ``tolerances`` are by output; None for an output restores its default. Another budget, target or tolerance, or
        resuming a failed design, makes a fit due. ``paused`` False, even if the surrogate was not paused, retries the
        queries that were set aside or refused, each with ``MAX_ATTEMPTS`` more attempts.

        After a change of target or tolerance, or a lower budget, adaptive queries without a real step so far are
        withdrawn, a running fit loses its lease, and the next fit chooses new queries. Queries requested by ``improve``
        are chosen again, unless the budget is lower. Initial queries are withdrawn only if they exceed the budget.
        """
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
                end_initial(connection, surrogate)
            if smaller is not None or changes.keys() & {"target", "tolerances"}:
                changes |= withdraw_unbegun(connection, surrogate, before, smaller)
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
        """Delete a surrogate and all its data.

        Its name can be used again at once. Its rows are removed in several transactions, so that other writers wait
        only briefly.
        """
        with self._database.write() as connection:
            id = _take_name(connection, name)
        _remove(self._database, id)

    def complete_removals(self) -> int:
        """Complete deletions of surrogates that a crash has interrupted, and return their number."""
        with self._database.read() as connection:
            ids = _interrupted(connection)
        for id in ids:
            _remove(self._database, id)
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
    """Return the phase of a design that waits for samples, given the number of its rounds so far."""
    return "sampling" if round else "collecting"


def _record(row: Row[Any]) -> SurrogateRecord:
    return SurrogateRecord(**row._mapping)


def _insert(connection: Connection, new: NewSurrogate) -> bool:
    """Insert a surrogate unless its name is taken, and return whether it was inserted."""
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


def withdraw_unbegun(
    connection: Connection, surrogate: Row[Any], before: SurrogateRecord, budget: int | None
) -> dict[str, Any]:
    """Withdraw those adaptive queries of a design that have no real step so far, and the lease of a running fit.

    A change of target, tolerance, prior or budget needs this. ``before`` is the surrogate before the change, and
    ``budget`` the new budget if it is lower, else None. With a lower budget, initial queries beyond it are withdrawn
    too; otherwise, steps that ``improve`` requested are requested again. Returns the columns of the surrogate that the
    caller has to change.
    """
    unbegun = is_unbegun(surrogate.id)
    statement = sa.delete(queries).where(unbegun, queries.c.purpose == "adaptive")
    withdrawn = connection.execute(statement.returning(queries.c.steps, queries.c.extra)).all()
    set_columns(connection, surrogate.id, **NO_RIGHT)
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


def _apply(connection: Connection, surrogate: Row[Any], changes: dict[str, Any]) -> None:
    if changes.keys() - {"paused"}:
        touch(connection, surrogate, **changes)
    else:
        set_columns(connection, surrogate.id, **changes)


# Fields of a summary that are columns of the table of surrogates.
SUMMARY_FIELDS = ("id", "name", "budget", "target", "phase", "paused", "round", "error", "created_at")
SUMMARY_COLUMNS = [getattr(surrogates.c, name) for name in SUMMARY_FIELDS]


ANSWERED = (
    sa.select(queries.c.surrogate_id, sa.func.count())
    .where(queries.c.surrogate_id.in_(sa.bindparam("owners", expanding=True)), queries.c.status == "answered")
    .group_by(queries.c.surrogate_id)
)


class _Named(msgspec.Struct):
    """The only field of a specification that the list of surrogates needs. Parsing all fields would take ten times as
    long."""

    environment: str = ""


_NAMED = msgspec.json.Decoder(_Named)


# Statuses that few queries have at a time. So an index makes it fast to count the queries with one of these statuses.
UNANSWERED = ("pending", "leased", "set_aside", "refused")
OPEN_COUNTS = [
    sa.select(sa.func.count())
    .where(queries.c.surrogate_id == surrogates.c.id, queries.c.status == status)
    .scalar_subquery()
    .label(status)
    for status in UNANSWERED
]
NEWEST = sa.select(sa.func.max(samples.c.id)).where(samples.c.surrogate_id == surrogates.c.id).scalar_subquery()
AT_ONCE = 1_000  # largest number of surrogates that one SQL statement reads


class Counted:
    """Cache of the numbers of samples and of answered queries of each surrogate.

    Both change only in transactions that add a sample. So a number of answered queries is valid as long as the newest
    sample is the same.
    """

    def __init__(self, samples: CountedSamples) -> None:
        self._samples = samples
        # By surrogate id: id of the surrogate's newest sample, and number of answered queries, when they were counted
        # last.
        self._answers: dict[int, tuple[int | None, int]] = {}

    def read(self, connection: Connection, newest: Mapping[int, int | None]) -> dict[int, tuple[SampleCounts, int]]:
        """Return the numbers of samples and of answered queries of each surrogate, by surrogate id.

        ``newest`` has the id of each surrogate's newest sample.
        """
        counts = self._samples.of_many(connection, newest)
        stale = [id for id in newest if self._answers.get(id, (-1, 0))[0] != newest[id]]
        for first in range(0, len(stale), AT_ONCE):
            self._count(connection, {id: newest[id] for id in stale[first : first + AT_ONCE]})
        return {id: (counts[id], self._answers[id][1]) for id in newest}

    def _count(self, connection: Connection, newest: Mapping[int, int | None]) -> None:
        rows = connection.execute(ANSWERED, {"owners": list(newest)}).all()
        counts_by_id = {int(id): int(count) for id, count in rows}
        if len(self._answers) > MOST_KEPT:
            self._answers = {}
        self._answers |= {id: (last, counts_by_id.get(id, 0)) for id, last in newest.items()}


def read_summaries(
    connection: Connection, condition: sa.ColumnElement[bool], limit: int | None, counts: Counted
) -> list[SurrogateSummary]:
    """Return summaries of up to ``limit`` surrogates that meet an SQL condition, oldest first.

    The condition must select a contiguous range of ids. ``counts`` is the cache of the surrogates' numbers of samples.
    """
    statement = (
        sa.select(*SUMMARY_COLUMNS, sa.type_coerce(surrogates.c.spec, sa.Text), NEWEST, *OPEN_COUNTS)
        .where(condition)
        .order_by(surrogates.c.id)
        .limit(limit)
    )
    rows = connection.execute(statement).all()
    if not rows:
        return []
    span = (rows[0].id, rows[-1].id)
    answers = counts.read(connection, {row.id: row[len(SUMMARY_COLUMNS) + 1] for row in rows})
    ledger_by_id = ledgers(connection, span, {id: sampled.counts for id, (sampled, _) in answers.items()})
    newest, none_spent = newest_of(connection, span), LedgerRecord()
    summaries = []
    for row in rows:
        id, *values, spec, _ = row[: len(SUMMARY_COLUMNS) + 2]
        queue = QueryCounts(answered=answers[id][1], **{status: row._mapping[status] for status in UNANSWERED})
        numbers = (ledger_by_id.get(id, none_spent), queue, *newest.get(id, (None, None)))
        fields: tuple[Any, ...] = (id, *values, _environment(spec), *numbers)
        summaries.append(SurrogateSummary(*fields))
    return summaries


def _environment(spec: str) -> str:
    try:
        return _NAMED.decode(spec).environment
    except msgspec.DecodeError as error:
        raise damaged(
            f"expected JSON in surrogates.spec, got {reprlib.repr(spec)}: {error}; restore a copy of the database"
        ) from error


LARGE = {models: 8, policies: 8}  # tables with large rows, and the number of rows to remove in one transaction
NO_RIGHT = {"fit_token": None, "fit_owner": None, "fit_expires": None, "fit_seconds": None}


def _take_name(connection: Connection, name: str) -> int:
    """Replace the name of a surrogate to be deleted, so that it is not found any more, and return its id. Raises
    ``UnknownSurrogate``."""
    id = int(hold(connection, name).id)
    for table in metadata.tables.values():
        if AT_ONCE in table.info:
            connection.execute(sa.delete(table).where(table.c.surrogate_id == id))
    set_columns(connection, id, name=f"{REMOVED}{id}", paused=True, **NO_RIGHT)
    return id


def _interrupted(connection: Connection) -> list[int]:
    """Return the ids of deleted surrogates that still have rows, because a crash interrupted their deletion."""
    return [*connection.execute(NAMELESS).scalars()]


def _remove(database: Database, id: int) -> None:
    """Remove all rows of a deleted surrogate, given its id. A repeat does nothing."""
    for table in reversed(metadata.sorted_tables):  # rows are removed before the rows to which they refer
        if "surrogate_id" in table.c:
            database.write_in_batches(partial(_remove_some, table, id))
    with database.write() as connection:
        connection.execute(sa.delete(surrogates).where(surrogates.c.id == id, ~IS_THERE))


def _remove_some(table: sa.Table, id: int, connection: Connection) -> int:
    key = sa.tuple_(*table.primary_key.columns)
    some = sa.select(*table.primary_key.columns).where(table.c.surrogate_id == id).limit(LARGE.get(table, BATCH))
    return connection.execute(sa.delete(table).where(key.in_(some))).rowcount
