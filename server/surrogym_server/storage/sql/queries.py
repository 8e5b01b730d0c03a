"""The queue of queries, and the snapshots at which some begin.

The initial queries of a design are queued in several short transactions. While some are missing, a row of the table
``requests`` holds the number of queued ones, and no fit is due. If a crash interrupts the work, another call of
``queue_initial`` with the same queries continues it.

A lease of a query has one answer: one sample, or the first samples of a rollout. All samples of an answer come in one
batch. The caller of a function on leases must have locked the surrogate (``rows.hold``) unless a docstring says
otherwise.
"""

from __future__ import annotations

import secrets
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from itertools import chain
from typing import Any, Literal, NamedTuple

import sqlalchemy as sa
from sqlalchemy.engine import Connection, Row

from surrogym_server.errors import (
    BeyondBudget,
    ForeignLease,
    IdempotencyConflict,
    InvalidInput,
    LeaseExpired,
    UnknownQuery,
)
from surrogym_server.storage.records import (
    FREE,
    LeasedQuery,
    NewSample,
    QueryRecord,
    fingerprint,
)
from surrogym_server.storage.sql.database import BATCH, NOW, Database, conflict_insert, constant
from surrogym_server.storage.sql.rows import (
    NAMED,
    append_event,
    find,
    has_ended,
    hold,
    recall,
    remember,
    sweep_table,
    touch,
    unknown_surrogate,
)
from surrogym_server.storage.sql.tables import leases, queries, requests, samples, snapshots, surrogates
from surrogym_shared.nouns import Query, Vector
from surrogym_shared.states import LEAST_AUDITED, Purpose, QueryStatus

MAX_ATTEMPTS = 3

CONTENT = [getattr(queries.c, name) for name in ("coordinates", "action", "steps", "snapshot", "replan", "policy")]
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


class Queries:
    """The storage of queries and their leases.

    A query is pending, leased, answered, set_aside or refused. If its lease fails or expires, it becomes pending again;
    after ``MAX_ATTEMPTS`` attempts it is set aside. A lease that ended before a real step does not count as an attempt.
    A query that the original environment refused is not leased again, and does not count towards the budget.
    """

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
        """Queue queries that a person or an audit (``purpose``) chose, and return their ids.

        Raises:
            BeyondBudget: all audits of the surrogate together would have more steps than its budget, and more than 128.
        """
        body = fingerprint(purpose, *(asdict(query) for query in new_queries))
        with self._database.write() as connection:
            surrogate = hold(connection, name, surrogates.c.budget)
            before: list[int] | None = recall(connection, surrogate, "enqueue", key, body)
            if before is not None:
                return before
            if purpose == "audit":
                _require_room(connection, surrogate, sum(query.steps for query in new_queries))
            ids = insert_queries(connection, surrogate, new_queries, purpose, surrogate.round)
            remember(connection, surrogate, "enqueue", key, body, ids)
            return ids

    def claim(self, name: str, sampler: str, limit: int, seconds: float) -> list[LeasedQuery]:
        """Lease up to ``limit`` pending queries to a sampler for ``seconds``, oldest first.

        First, expired leases are ended. If the surrogate is paused, the result is empty.
        """
        with self._database.write() as connection:
            surrogate = share(connection, name)
            if surrogate.paused:
                return []
            rows = connection.execute(OLDEST_FREE, {"owner": surrogate.id, "most": limit}).all()
            return begin_leases(connection, surrogate, rows, sampler, seconds)

    def renew(self, name: str, query_id: int, token: str, seconds: float) -> float:
        """Extend the lease of a query to ``seconds`` from now, and return the time of its end.

        Raises:
            UnknownQuery: the surrogate has no such query.
            ForeignLease: the token is not that of a lease of this query.
            LeaseExpired: the lease has expired, or ended with an answer or a failure.
        """
        with self._database.write() as connection:
            lease = find_lease(connection, find(connection, name), query_id, token)
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
        """End the lease of a query that could not be answered. The query becomes pending again. After its last attempt
        it is set aside: it is kept, but not leased again. A refused query is not leased again either.

        A repeat changes nothing. If the query begins at a snapshot that was dropped during the lease, the query is
        removed, or set aside if a step may have been taken.

        Args:
            name: name of the surrogate.
            query_id: id of the query.
            token: token of the lease.
            error: description of the failure.
            begun: whether a real step may have been taken. If so, the ledger counts the steps of the query as
                unresolved.
            refused: whether the original environment refused the query before a real step; ``begun`` is then ignored.

        Raises:
            UnknownQuery: the surrogate has no such query.
            ForeignLease: the token is not that of a lease of this query.
            LeaseExpired: the lease has expired, or ended with an answer.
        """
        outcome: Returned = "refused" if refused else "failed" if begun else "unbegun"
        with self._database.write() as connection:
            surrogate = hold(connection, name)
            lease = find_lease(connection, surrogate.id, query_id, token)
            if lease.outcome == "open" and lease.expires > surrogate.now:
                set_outcome(connection, [lease.id], outcome)
                give_back(connection, surrogate, [query_id], error, outcome)
                given_back = _read(connection, surrogate.id, query_id)
                give_up_lost(connection, surrogate, given_back)
                return given_back
            elif lease.outcome != outcome:
                raise _lease_expired(query_id)
            return _read(connection, surrogate.id, query_id)

    def withdraw(self, name: str, query_ids: Sequence[int]) -> int:
        """Remove queries, given by their ids, and return the number removed. A query stays if it is not pending, or if
        a real step of it may have been taken."""
        with self._database.write() as connection:
            surrogate = hold(connection, name)
            condition = queries.c.id.in_(query_ids) & is_unbegun(surrogate.id)
            gone = len(connection.execute(sa.delete(queries).where(condition).returning(queries.c.id)).all())
            if gone:
                append_event(connection, surrogate, "queries", withdrawn=gone, round=surrogate.round)
            return gone

    def get(self, name: str, query_id: int) -> QueryRecord:
        """Return the record of a query. Raises ``UnknownQuery`` if the surrogate has no such query."""
        with self._database.read() as connection:
            return _read(connection, find(connection, name), query_id)

    def list(self, name: str, statuses: Sequence[QueryStatus] = (), limit: int = 10_000) -> list[QueryRecord]:
        """Return up to ``limit`` queries with one of the ``statuses`` (empty: any status), oldest first."""
        with self._database.read() as connection:
            statement = _records().where(queries.c.surrogate_id == find(connection, name))
            if statuses:
                statement = statement.where(queries.c.status.in_(statuses))
            rows = connection.execute(statement.order_by(queries.c.id).limit(limit))
            return [_record(row) for row in rows]

    def sweep_expired(self) -> int:
        """End the expired leases of all surrogates, and return their number.

        A lease with more time left than its duration, because the clock was set back, is shortened to its duration.
        """
        return sweep_table(self._database, leases, IS_OPEN, sweep_leases)


def _require_room(connection: Connection, surrogate: Row[Any], steps: int) -> None:
    """Raise ``BeyondBudget`` if the surrogate's audits, with ``steps`` more real steps, would take more than its budget
    and more than ``LEAST_AUDITED`` steps."""
    before = spoken_for(connection, surrogate.id, audits=True)
    limit = max(int(surrogate.budget), LEAST_AUDITED)
    if before + steps > limit:
        raise BeyondBudget(
            f"expected at most {max(0, limit - before)} more real steps of audits, got {steps}: all audits "
            f"together may take {limit}, the larger of the budget and {LEAST_AUDITED}; raise the budget with surrogym "
            "change --budget"
        )


def spoken_for(connection: Connection, surrogate_id: int, *, audits: bool = False) -> int:
    """Return the number of real steps that count towards the budget, or those of ``audits``: samples, and steps of
    unanswered queries.

    Queries that were set aside count, because steps may have been taken; refused queries don't.
    """

    def counts(table: sa.Table) -> sa.ColumnElement[bool]:
        own = table.c.purpose == "audit" if audits else table.c.purpose.not_in(FREE)
        return (table.c.surrogate_id == surrogate_id) & own

    sampled = sa.select(sa.func.count()).where(counts(samples))
    steps = sa.select(sa.func.coalesce(sa.func.sum(queries.c.steps), 0)).where(
        counts(queries), queries.c.status.not_in(("answered", "refused"))
    )
    return int(connection.execute(sa.select(sampled.scalar_subquery() + steps.scalar_subquery())).scalar_one())


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
        raise unknown_query(query_id)
    return _record(row)


def _record(row: Row[Any]) -> QueryRecord:
    state = {column.name: row._mapping[column.name] for column in STATE}
    return QueryRecord(**query_in(row), **state, lease_seconds_left=row.lease_seconds_left)


GONE = "its snapshot is gone"


class Snapshots:
    """The storage of the names and coordinates of samplers' snapshots; ``Samples.add`` adds them."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def all(self, name: str) -> dict[str, Vector]:
        """Return the coordinates (C,) of the state in each snapshot of a surrogate, by the snapshot's name, oldest
        first."""
        with self._database.read() as connection:
            own = snapshots.c.surrogate_id == find(connection, name)
            statement = sa.select(snapshots.c.name, snapshots.c.coordinates).where(own).order_by(snapshots.c.id)
            return {row.name: row.coordinates for row in connection.execute(statement)}

    def drop(self, name: str, snapshots: Sequence[str]) -> int:
        """Remove snapshots, and return the number removed. Unknown names are skipped.

        Pending queries that begin at a removed snapshot are removed too. If a real step may have been taken, they are
        set aside instead: they are kept, but not leased again. A fit becomes due, which chooses other queries.
        """
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
    """Give up the query ``given_back``, whose lease has ended, if its snapshot was dropped during the lease: remove the
    query, or set it aside (keep it, but don't lease it again). Otherwise samplers would claim it repeatedly."""
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
    unbegun = is_unbegun(surrogate.id) & from_there
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


# How a lease of a query ended without an answer; unbegun: before a real step.
Returned = Literal["failed", "expired", "unbegun", "refused"]
BEFORE_A_STEP = ("unbegun", "refused")
EXPIRED = "no answer before the lease ended"
NEW_LEASE = sa.insert(leases)
LEASE_QUERIES = (
    sa.update(queries)
    .where(queries.c.id.in_(sa.bindparam("claimed", expanding=True)))
    .values(status="leased", attempts=queries.c.attempts + 1, sampler=sa.bindparam("claimer"))
)
SET_OUTCOME = (
    sa.update(leases).where(leases.c.id.in_(sa.bindparam("ended", expanding=True))).values(outcome=sa.bindparam("how"))
)
# The value is a constant in the SQL text, because with a parameter PostgreSQL would not use the index of open leases.
IS_OPEN = leases.c.outcome == constant("open")
ENDED = sa.exists().where(leases.c.surrogate_id == surrogates.c.id, has_ended(leases, IS_OPEN))
SHARE = (
    sa.select(surrogates.c.id, surrogates.c.paused, NOW.label("now"), ENDED.label("has_ended"))
    .where(NAMED)
    .with_for_update(read=True, key_share=True)
)


def begin_leases(
    connection: Connection, surrogate: Row[Any], rows: Sequence[Row[Any]], sampler: str, seconds: float
) -> list[LeasedQuery]:
    """Lease the queries in these rows, which the caller has locked, to one sampler for ``seconds``."""
    if not rows:
        return []
    leased = [
        LeasedQuery(
            **query_in(row),
            id=row.id,
            purpose=row.purpose,
            number=row.number,
            attempt=row.attempts + 1,
            token=secrets.token_urlsafe(16),
            expires=surrogate.now + seconds,
        )
        for row in rows
    ]
    connection.execute(NEW_LEASE, [_lease_row(surrogate, query, sampler, seconds) for query in leased])
    connection.execute(LEASE_QUERIES, {"claimed": [query.id for query in leased], "claimer": sampler})
    return leased


def _lease_row(surrogate: Row[Any], query: LeasedQuery, sampler: str, seconds: float) -> dict[str, Any]:
    return {
        "surrogate_id": surrogate.id,
        "query_id": query.id,
        "token": query.token,
        "sampler": sampler,
        "attempt": query.attempt,
        "begun": surrogate.now,
        "expires": query.expires,
        "seconds": seconds,
        "outcome": "open",
    }


def find_lease(connection: Connection, surrogate_id: int, query_id: int, token: str) -> Row[Any]:
    """Return the columns id, expires and outcome of a query's lease with this token. The surrogate need not be locked.

    Raises:
        UnknownQuery: the surrogate has no such query.
        ForeignLease: the token is not that of a lease of this query.
    """
    columns: list[Any] = [leases.c.id, leases.c.expires, leases.c.outcome]
    given_out = sa.select(*columns).where(
        leases.c.surrogate_id == surrogate_id, leases.c.query_id == query_id, leases.c.token == token
    )
    lease = connection.execute(given_out).one_or_none()
    if lease is not None:
        return lease
    own = sa.select(queries.c.id).where(queries.c.surrogate_id == surrogate_id, queries.c.id == query_id)
    if connection.execute(own).one_or_none() is None:
        raise unknown_query(query_id)
    raise foreign_lease(query_id)


def unknown_query(query_id: int) -> UnknownQuery:
    return UnknownQuery(f"expected the id of a query of this surrogate, got {query_id}, which does not exist")


def foreign_lease(query_id: int) -> ForeignLease:
    return ForeignLease(f"expected a lease token of query {query_id}, got another token: send the one of its claim")


def set_outcome(connection: Connection, lease_ids: Sequence[int], outcome: str) -> None:
    connection.execute(SET_OUTCOME, {"ended": lease_ids, "how": outcome})


def share(connection: Connection, name: str) -> Row[Any]:
    """Lock a surrogate against deletion, without blocking writers, and end expired leases of its queries.

    Returns a row with the columns id, paused, now (the database's time), and has_ended (whether leases had expired).
    """
    row = connection.execute(SHARE, {"named": name}).one_or_none()
    if row is None:
        raise unknown_surrogate(name)
    if row.has_ended:
        sweep_leases(connection, hold(connection, name))
    return row


def sweep_leases(connection: Connection, surrogate: Row[Any]) -> int:
    """End the expired leases of a surrogate's queries, and return their number."""
    result = connection.execute(
        sa.update(leases)
        .where(leases.c.surrogate_id == surrogate.id, leases.c.outcome == "open", leases.c.expires <= surrogate.now)
        .values(outcome="expired")
        .returning(leases.c.query_id)
    )
    ids = [int(id) for id in result.scalars()]
    if ids:
        give_back(connection, surrogate, ids, EXPIRED, "expired")
    return len(ids)


def give_back(
    connection: Connection, surrogate: Row[Any], query_ids: Sequence[int], error: str, outcome: Returned
) -> None:
    """Make queries whose lease has ended pending again, or set them aside after their last attempt or a refusal.

    A lease that ended before a real step does not count as an attempt. If a person makes a query pending again that was
    set aside, it gets all attempts again. ``error`` is stored with the queries. The caller must have stored
    ``outcome``, which says how the leases ended, with the leases before.
    """
    failures = (
        sa.select(sa.func.count())
        .where(leases.c.query_id == queries.c.id, leases.c.outcome.in_(("failed", "expired")))
        .scalar_subquery()
    )
    last = sa.false() if outcome in BEFORE_A_STEP else sa.true()
    if_failed = sa.case((last & (failures % MAX_ATTEMPTS == 0), "set_aside"), else_="pending")
    next_status = sa.literal("refused") if outcome == "refused" else if_failed
    rows = connection.execute(
        sa.update(queries)
        .where(queries.c.id.in_(query_ids), queries.c.status == "leased")
        .values(status=next_status, error=error)
        .returning(queries.c.id, queries.c.status)
    )
    statuses = {row.id: row.status for row in rows}
    set_aside = sorted(id for id, status in statuses.items() if status != "pending")
    for query_id in set_aside:
        append_event(connection, surrogate, "set_aside", query_id=query_id, error=error)
    if set_aside:
        touch(connection, surrogate)
    if len(statuses) > len(set_aside):
        append_event(connection, surrogate, "queries", given_back=len(statuses) - len(set_aside))


def is_unbegun(surrogate_id: int) -> sa.ColumnElement[bool]:
    """Return the SQL condition that a query of this surrogate is pending and that certainly no real step of it was
    taken."""
    leases_with_steps = sa.select(leases.c.id).where(
        leases.c.query_id == queries.c.id, leases.c.outcome.not_in(BEFORE_A_STEP)
    )
    return (queries.c.surrogate_id == surrogate_id) & (queries.c.status == "pending") & ~sa.exists(leases_with_steps)


def requeue_set_aside(connection: Connection, surrogate: Row[Any]) -> int:
    """Make a surrogate's queries that were set aside or refused pending again, with all attempts. Return their number.

    Those of audits are left, because an audit does not wait for queries that failed.
    """
    again = queries.c.status.in_(("set_aside", "refused")) & (queries.c.purpose != "audit")
    own = queries.c.surrogate_id == surrogate.id
    return connection.execute(sa.update(queries).where(own, again).values(status="pending")).rowcount


NAMED_QUERIES: sa.Select[Any] = (
    sa.select(queries.c.id, queries.c.purpose, queries.c.steps)
    .where(queries.c.surrogate_id == sa.bindparam("owner"), queries.c.id.in_(sa.bindparam("query_ids", expanding=True)))
    .order_by(queries.c.id)
    .with_for_update()
)
LIVE = (leases.c.outcome == "open") & (leases.c.expires > sa.bindparam("now", type_=sa.Double()))
LEASES = sa.select(leases.c.id, leases.c.query_id, leases.c.token, leases.c.attempt, LIVE.label("live")).where(
    leases.c.query_id.in_(sa.bindparam("asked", expanding=True))
)
REPORTED = sa.select(samples.c.lease_id, samples.c.step, samples.c.id, samples.c.fingerprint).where(
    samples.c.lease_id.in_(sa.bindparam("reported", expanding=True))
)
ANSWER = (
    sa.update(queries)
    .where(queries.c.id.in_(sa.bindparam("done", expanding=True)))
    .values(status="answered", error=None)
)


class Reported(NamedTuple):
    """Id and content hash of a stored sample, to recognise a repeated report of it."""

    sample_id: int
    fingerprint: str


@dataclass(frozen=True)
class Answered:
    """A lease of a query under which a sampler reports samples as the answer, with fields of the query."""

    lease_id: int
    query_id: int
    purpose: Purpose
    steps: int  # largest number of real steps of the query
    attempt: int
    live: bool  # whether the lease has not ended
    contested: bool  # whether the query has another lease that has not ended
    reported: dict[int, Reported]  # samples that were stored before as the answer under this lease, by step


def read_answered(connection: Connection, surrogate: Row[Any], batch: Sequence[NewSample]) -> list[Answered | None]:
    """Return the lease of each reported sample, or None for a sample without a query. Locks the queries.

    Raises:
        UnknownQuery: the surrogate has no such query.
        ForeignLease: the lease token is not that of a lease of the query.
        InvalidInput: a sample has a lease token without a query, or an answer lacks a step or has too many.
        IdempotencyConflict: an answer has more steps than when it was reported first.
    """
    query_ids = {sample.query_id for sample in batch if sample.query_id is not None}
    by_id = _lock_queries(connection, surrogate, query_ids)
    by_token = _leases(connection, surrogate, by_id)
    answers = [_lease_of(sample, by_id, by_token) for sample in batch]
    steps: dict[int, set[int]] = defaultdict(set)
    for sample, lease in zip(batch, answers, strict=True):
        if lease is not None:
            steps[lease.lease_id].add(sample.step)
    for lease in {lease.lease_id: lease for lease in answers if lease}.values():
        _check_steps(lease, steps[lease.lease_id])
    return answers


def settle(connection: Connection, answers: Iterable[Answered]) -> None:
    """Mark leases and their queries as answered. A query stays leased if its answered lease had ended and another lease
    of it is open."""
    leases_done = {one.lease_id: one for one in answers}
    if not leases_done:
        return
    set_outcome(connection, list(leases_done), "answered")
    query_ids = [one.query_id for one in leases_done.values() if one.live or not one.contested]
    if query_ids:
        connection.execute(ANSWER, {"done": query_ids})


def _check_steps(lease: Answered, steps: set[int]) -> None:
    """Check the steps that are reported as the answer under a lease.

    Raises:
        InvalidInput: a step is missing, or there are more than the query has.
        IdempotencyConflict: there are more steps than when the answer was reported first.
    """
    if lease.reported:
        if more := steps - lease.reported.keys():
            raise IdempotencyConflict(
                f"expected the {len(lease.reported)} samples first reported for query {lease.query_id}, got step "
                f"{min(more)} in addition: a stored answer can't be extended"
            )
    elif steps != set(range(len(steps))) or len(steps) > lease.steps:
        raise InvalidInput(
            f"expected steps 0, 1, ... of query {lease.query_id}, at most {lease.steps} of them, got the steps "
            f"{sorted(steps)}: send the whole answer in one request"
        )


def _lock_queries(connection: Connection, surrogate: Row[Any], query_ids: set[int]) -> dict[int, Row[Any]]:
    if not query_ids:
        return {}
    return {
        row.id: row for row in connection.execute(NAMED_QUERIES, {"owner": surrogate.id, "query_ids": list(query_ids)})
    }


def _leases(connection: Connection, surrogate: Row[Any], by_id: dict[int, Row[Any]]) -> dict[tuple[int, str], Answered]:
    """Read all leases of the queries ``by_id``. Return the leases by query id and token."""
    if not by_id:
        return {}
    rows = connection.execute(LEASES, {"asked": list(by_id), "now": surrogate.now}).all()
    reported = _reported(connection, [row.id for row in rows])
    live_ids = {row.query_id: row.id for row in rows if row.live}
    return {
        (row.query_id, row.token): Answered(
            lease_id=row.id,
            query_id=row.query_id,
            purpose=by_id[row.query_id].purpose,
            steps=by_id[row.query_id].steps,
            attempt=row.attempt,
            live=bool(row.live),
            contested=live_ids.get(row.query_id, row.id) != row.id,
            reported=reported[row.id],
        )
        for row in rows
    }


def _reported(connection: Connection, lease_ids: Sequence[int]) -> dict[int, dict[int, Reported]]:
    """Return the stored samples of each of these leases, by lease id and step."""
    reported: dict[int, dict[int, Reported]] = defaultdict(dict)
    for lease_id, step, *columns in connection.execute(REPORTED, {"reported": lease_ids}):
        reported[lease_id][step] = Reported(*columns)
    return reported


def _lease_of(
    sample: NewSample, by_id: dict[int, Row[Any]], by_token: dict[tuple[int, str], Answered]
) -> Answered | None:
    if sample.query_id is None:
        if sample.lease_token is not None:
            raise InvalidInput(
                "expected query_id together with lease_token, got lease_token alone: send both, as the claim gave them"
            )
        return None
    if sample.query_id not in by_id:
        raise unknown_query(sample.query_id)
    lease = by_token.get((sample.query_id, sample.lease_token or ""))
    if lease is None:
        raise foreign_lease(sample.query_id)
    return lease


def insert_queries(
    connection: Connection,
    surrogate: Row[Any],
    new_queries: Sequence[Query],
    purpose: Purpose,
    round: int,
    *,
    extra: bool = False,
) -> list[int]:
    """Insert queries as pending, and return their ids in the same order.

    ``round`` is the number of the design's round that chose them. ``extra`` marks queries that were only chosen because
    ``improve`` requested them.
    """
    if not new_queries:
        return []
    common = {"surrogate_id": surrogate.id, "purpose": purpose, "round": round, "status": "pending", "attempts": 0}
    common["extra"] = extra
    rows = [common | _columns(query) for query in new_queries]
    insert = sa.insert(queries).returning(queries.c.id, sort_by_parameter_order=True)
    ids = [int(id) for id in connection.execute(insert, rows).scalars()]
    append_event(connection, surrogate, "queries", count=len(ids), purpose=purpose, round=round)
    return ids


def _columns(query: Query) -> dict[str, Any]:
    """Convert a query to the columns of its row. The actions (T, F) become one vector (T * F,)."""
    return {
        "kind": query.kind,
        "coordinates": query.coordinates,
        "action": tuple(chain.from_iterable(query.actions)),
        "steps": query.steps,
        "snapshot": query.snapshot,
        "replan": query.replan,
        "policy": query.policy,
    }


def query_in(row: Row[Any]) -> dict[str, Any]:
    """Convert a row with columns ``coordinates``, ``action``, ``steps``, ``snapshot``, ``replan`` and ``policy`` to
    fields of a ``Query``."""
    size = max(1, len(row.action) // row.steps)
    actions = tuple(row.action[first : first + size] for first in range(0, len(row.action), size))
    how = {"snapshot": row.snapshot, "replan": row.replan, "policy": row.policy}
    return {"coordinates": row.coordinates, "actions": actions, **how}
