"""Implementations of ``Queries`` and ``Snapshots``: the queue of queries, and the snapshots at which some begin.

The initial queries of a design are queued in several short transactions. While some are missing, a row of the table
``requests`` holds the number of queued ones, and no fit is due. If a crash interrupts the work, another call of
``queue_initial`` with the same queries continues it.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection, Row

from surrogym_server.errors import BeyondBudget, LeaseExpired, UnknownSurrogate
from surrogym_server.storage import port
from surrogym_server.storage.records import (
    LeasedQuery,
    QueryCounts,
    QueryRecord,
    fingerprint,
)
from surrogym_server.storage.sql import leases as leasing
from surrogym_server.storage.sql.database import BATCH, NOW, Database, conflict_insert
from surrogym_server.storage.sql.rows import (
    NAMED,
    Span,
    append_event,
    find,
    has_ended,
    hold,
    insert_queries,
    is_too_long,
    query_in,
    recall,
    remember,
    shorten,
    touch,
    within,
)
from surrogym_server.storage.sql.tables import leases, queries, requests, snapshots, surrogates
from surrogym_shared.nouns import Query, Vector
from surrogym_shared.states import Purpose, QueryStatus

CONTENT = [getattr(queries.c, name) for name in ("coordinates", "action", "steps", "snapshot")]
STATE = [getattr(queries.c, name) for name in ("id", "purpose", "status", "round", "attempts", "sampler", "error")]

_EARLIER = queries.alias()
NUMBER = (
    sa.select(sa.func.count())
    .where(_EARLIER.c.surrogate_id == sa.bindparam("owner"), _EARLIER.c.id < queries.c.id)
    .scalar_subquery()
)
OLDEST_FREE: sa.Select[Any] = (
    sa.select(*STATE, *CONTENT, NUMBER.label("number"))
    .where(queries.c.surrogate_id == sa.bindparam("owner"), queries.c.status == "pending")
    .order_by(queries.c.id)
    .limit(sa.bindparam("most", type_=sa.Integer()))
    .with_for_update(skip_locked=True)
)
# All audits of a surrogate may take this many real steps even if its budget is smaller: three
# audits of 40 steps.
LEAST_AUDITED = 128


class SqlQueries(port.Queries):
    def __init__(self, database: Database) -> None:
        self._database = database

    def enqueue(
        self,
        name: str,
        new_queries: Sequence[Query],
        *,
        purpose: Purpose = "manual",
        key: str | None = None,
    ) -> list[int]:
        body = fingerprint(purpose, *(asdict(query) for query in new_queries))
        with self._database.write() as connection:
            surrogate = hold(connection, name)
            before: list[int] | None = recall(connection, surrogate, "enqueue", key, body)
            if before is not None:
                return before
            if purpose == "audit":
                _require_room(connection, surrogate, sum(query.steps for query in new_queries))
            ids = insert_queries(connection, surrogate, new_queries, purpose, surrogate.round)
            remember(connection, surrogate, "enqueue", key, body, ids)
            return ids

    def claim(self, name: str, sampler: str, limit: int, seconds: float) -> list[LeasedQuery]:
        with self._database.write() as connection:
            surrogate = leasing.share(connection, name)
            if surrogate.paused:
                return []
            rows = connection.execute(OLDEST_FREE, {"owner": surrogate.id, "most": limit}).all()
            return leasing.begin(connection, surrogate, rows, sampler, seconds)

    def renew(self, name: str, query_id: int, token: str, seconds: float) -> float:
        with self._database.write() as connection:
            lease = leasing.of_query(connection, find(connection, name), query_id, token)
            live = (leases.c.outcome == "open") & (leases.c.expires > NOW)
            renewed = connection.execute(
                sa.update(leases)
                .where(leases.c.id == lease.id, live)
                .values(expires=NOW + seconds, seconds=seconds)
                .returning(leases.c.expires)
            ).scalar()
            if renewed is None:
                raise _lease_expired(query_id)
            return float(renewed)

    def fail(
        self, name: str, query_id: int, token: str, error: str, *, begun: bool = True, refused: bool = False
    ) -> QueryRecord:
        outcome: leasing.Returned = "refused" if refused else "failed" if begun else "unbegun"
        with self._database.write() as connection:
            surrogate = hold(connection, name)
            lease = leasing.of_query(connection, surrogate.id, query_id, token)
            if lease.outcome == "open" and lease.expires > surrogate.now:
                leasing.set_outcome(connection, [lease.id], outcome)
                leasing.give_back(connection, surrogate, [query_id], error, outcome)
                given_back = _read(connection, surrogate.id, query_id)
                give_up_lost(connection, surrogate, given_back)
                return given_back
            elif lease.outcome != outcome:
                raise _lease_expired(query_id)
            return _read(connection, surrogate.id, query_id)

    def withdraw(self, name: str, query_ids: Sequence[int]) -> int:
        with self._database.write() as connection:
            surrogate = hold(connection, name)
            condition = queries.c.id.in_(query_ids) & leasing.is_unbegun(surrogate.id)
            gone = len(connection.execute(sa.delete(queries).where(condition).returning(queries.c.id)).all())
            if gone:
                append_event(connection, surrogate, "queries", withdrawn=gone, round=surrogate.round)
            return gone

    def get(self, name: str, query_id: int) -> QueryRecord:
        with self._database.read() as connection:
            return _read(connection, find(connection, name), query_id)

    def list(self, name: str, statuses: Sequence[QueryStatus] = (), limit: int = 10_000) -> list[QueryRecord]:
        with self._database.read() as connection:
            statement = _records().where(queries.c.surrogate_id == find(connection, name))
            if statuses:
                statement = statement.where(queries.c.status.in_(statuses))
            rows = connection.execute(statement.order_by(queries.c.id).limit(limit))
            return [_record(row) for row in rows]

    def counts(self, name: str) -> QueryCounts:
        with self._database.read() as connection:
            id = find(connection, name)
            return query_counts(connection, (id, id)).get(id, QueryCounts())

    def sweep_expired(self) -> int:
        with self._database.read() as connection:
            ended = has_ended(leases, leasing.IS_OPEN)
            owners = sa.select(leases.c.surrogate_id).where(ended).distinct()
            statement = sa.select(surrogates.c.name).where(surrogates.c.id.in_(owners))
            names = list(connection.execute(statement).scalars())
            too_long = is_too_long(leases, leasing.IS_OPEN)
            set_back = connection.execute(sa.select(sa.exists().where(too_long))).scalar()
        if set_back:
            with self._database.write() as connection:
                shorten(connection, leases, leasing.IS_OPEN)
        return sum(self._sweep(name) for name in names)

    def _sweep(self, name: str) -> int:
        try:
            with self._database.write() as connection:
                return leasing.sweep(connection, hold(connection, name))
        except UnknownSurrogate:  # the surrogate was just deleted
            return 0


def _require_room(connection: Connection, surrogate: Row[Any], steps: int) -> None:
    """Raise ``BeyondBudget`` if the surrogate's audits, with ``steps`` more real steps, would take more than its budget
    and more than ``LEAST_AUDITED`` steps."""
    sums = sa.select(sa.func.coalesce(sa.func.sum(queries.c.steps), 0), sa.func.max(surrogates.c.budget))
    own = (queries.c.surrogate_id == surrogates.c.id) & (queries.c.purpose == "audit")
    join = sums.select_from(surrogates.outerjoin(queries, own)).where(surrogates.c.id == surrogate.id)
    before, budget = connection.execute(join).one()
    limit = max(int(budget), LEAST_AUDITED)
    if before + steps > limit:
        raise BeyondBudget(
            f"expected at most {max(0, limit - int(before))} more real steps of audits, got {steps}: all audits "
            f"together may take {limit}, the larger of the budget and {LEAST_AUDITED}; raise the budget with surrogym "
            "change --budget"
        )


def query_counts(connection: Connection, span: Span) -> dict[int, QueryCounts]:
    """Return the numbers of queries by status of the surrogates in a range of ids, by id. Surrogates without queries
    are left out."""
    of_surrogates: defaultdict[int, dict[str, int]] = defaultdict(dict)
    statement = sa.select(queries.c.surrogate_id, queries.c.status, sa.func.count()).where(within(queries, span))
    rows = connection.execute(statement.group_by(queries.c.surrogate_id, queries.c.status)).all()
    for surrogate, status, count in rows:
        of_surrogates[surrogate][status] = count
    return {surrogate: QueryCounts(**counts) for surrogate, counts in of_surrogates.items()}


def _lease_expired(query_id: int) -> LeaseExpired:
    return LeaseExpired(f"the lease of query {query_id} has ended: claim a query again")


def _records() -> sa.Select[Any]:
    """Return the SELECT of queries with the time left of their open lease; a query has at most one."""
    left = (leases.c.expires - NOW).label("lease_seconds_left")
    is_open = (leases.c.query_id == queries.c.id) & (leases.c.outcome == "open")
    return sa.select(*STATE, *CONTENT, left).outerjoin(leases, is_open)


def _read(connection: Connection, surrogate_id: int, query_id: int) -> QueryRecord:
    statement = _records().where(queries.c.surrogate_id == surrogate_id, queries.c.id == query_id)
    row = connection.execute(statement).one_or_none()
    if row is None:
        raise leasing.unknown_query(query_id)
    return _record(row)


def _record(row: Row[Any]) -> QueryRecord:
    state = {column.name: row._mapping[column.name] for column in STATE}
    return QueryRecord(**query_in(row), **state, lease_seconds_left=row.lease_seconds_left)


GONE = "its snapshot is gone"


class SqlSnapshots(port.Snapshots):
    def __init__(self, database: Database) -> None:
        self._database = database

    def all(self, name: str) -> dict[str, Vector]:
        with self._database.read() as connection:
            own = snapshots.c.surrogate_id == find(connection, name)
            statement = sa.select(snapshots.c.name, snapshots.c.coordinates).where(own).order_by(snapshots.c.id)
            return {row.name: row.coordinates for row in connection.execute(statement)}

    def drop(self, name: str, snapshots: Sequence[str]) -> int:
        with self._database.write() as connection:
            surrogate = hold(connection, name)
            gone = _forget(connection, surrogate, snapshots)
            _give_up_queries(connection, surrogate, snapshots)
            return gone


def insert_snapshots(connection: Connection, surrogate: Row[Any], new: dict[str, Vector]) -> None:
    """Store the names of new snapshots with their coordinates (C,). Stored snapshots are not changed."""
    if new:
        rows = [{"surrogate_id": surrogate.id, "name": name, "coordinates": at} for name, at in new.items()]
        insert = conflict_insert(connection, snapshots).on_conflict_do_nothing()
        connection.execute(insert, rows)


def give_up_lost(connection: Connection, surrogate: Row[Any], given_back: QueryRecord) -> None:
    """Remove or set aside the query ``given_back``, whose lease has ended, if its snapshot was dropped during the
    lease. Otherwise samplers would claim it repeatedly."""
    if given_back.snapshot is None or given_back.status != "pending":
        return
    own = (snapshots.c.surrogate_id == surrogate.id) & (snapshots.c.name == given_back.snapshot)
    if not connection.execute(sa.select(sa.exists().where(own))).scalar():
        _give_up_queries(connection, surrogate, [given_back.snapshot])


def _forget(connection: Connection, surrogate: Row[Any], names: Sequence[str]) -> int:
    own = (snapshots.c.surrogate_id == surrogate.id) & snapshots.c.name.in_(names)
    return len(connection.execute(sa.delete(snapshots).where(own).returning(snapshots.c.id)).all())


def _give_up_queries(connection: Connection, surrogate: Row[Any], names: Sequence[str]) -> None:
    """Remove pending queries that begin at the dropped snapshots ``names``; set aside those of which a real step may
    have been taken.

    Removed queries that ``improve`` had requested are requested again.
    """
    from_there = queries.c.snapshot.in_(names)
    unbegun = leasing.is_unbegun(surrogate.id) & from_there
    removed = connection.execute(sa.delete(queries).where(unbegun).returning(queries.c.steps, queries.c.extra)).all()
    waiting = (queries.c.surrogate_id == surrogate.id) & (queries.c.status == "pending") & from_there
    aside = sa.update(queries).where(waiting).values(status="set_aside", error=GONE).returning(queries.c.id)
    leases_begun = sorted(connection.execute(aside).scalars())
    if removed:
        append_event(connection, surrogate, "queries", withdrawn=len(removed), round=surrogate.round)
    for query_id in leases_begun:
        append_event(connection, surrogate, "set_aside", query_id=query_id, error=GONE)
    if removed or leases_begun:
        again = sum(row.steps for row in removed if row.extra)
        touch(connection, surrogate, extra_queries=surrogates.c.extra_queries + again)


# Operation and key of the row of ``requests`` that counts the queued initial queries. Clients can't use an empty key.
INITIAL, NO_KEY = "initial", ""
_OF_DESIGN = (requests.c.operation == INITIAL) & (requests.c.key == NO_KEY)
IS_INCOMPLETE = sa.exists(  # condition on a row of surrogates: some of its initial queries are missing
    sa.select(requests.c.key).where(requests.c.surrogate_id == surrogates.c.id, _OF_DESIGN)
)


def begin_initial(connection: Connection, surrogate: Row[Any], queries: Sequence[Query]) -> None:
    """Queue the first batch of a surrogate's initial queries. If further ones are missing, a row of the table
    ``requests`` has the number of those that are queued."""
    remember(connection, surrogate, INITIAL, NO_KEY, "", 0)
    _ask_some(connection, surrogate, queries)


def end_initial(connection: Connection, surrogate: Row[Any]) -> None:
    """Record that no initial query of a surrogate is missing any more."""
    connection.execute(sa.delete(requests).where(requests.c.surrogate_id == surrogate.id, _OF_DESIGN))


def queue_initial(database: Database, name: str, queries: Sequence[Query]) -> None:
    """Queue the missing initial queries of a surrogate, given all its initial queries. Does nothing if none is missing.

    Raises ``UnknownSurrogate``.
    """

    def batch(connection: Connection) -> int:
        return _ask_some(connection, hold(connection, name), queries)

    with database.read() as connection:
        missing = connection.execute(sa.select(surrogates.c.id).where(NAMED, IS_INCOMPLETE), {"named": name}).first()
    if missing:
        database.write_in_batches(batch)


def _ask_some(connection: Connection, surrogate: Row[Any], queries: Sequence[Query]) -> int:
    """Queue a batch of a surrogate's missing initial queries, given all initial queries. Return the number queued."""
    own = (requests.c.surrogate_id == surrogate.id) & _OF_DESIGN
    queued = connection.execute(sa.select(requests.c.result).where(own)).scalar()
    if queued is None:
        return 0
    first, last = int(queued), int(queued) + BATCH
    ids = insert_queries(connection, surrogate, queries[first:last], "initial", 0)
    if last >= len(queries):
        end_initial(connection, surrogate)
    else:
        connection.execute(sa.update(requests).where(own).values(result=last))
    return len(ids)
