"""Leases of queries: how they begin and end. The caller holds the surrogate unless a docstring says otherwise."""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from typing import Any, Literal

import sqlalchemy as sa
from sqlalchemy.engine import Connection, Row

from surrogym_server.errors import ForeignLease, UnknownQuery
from surrogym_server.storage.port import MAX_ATTEMPTS
from surrogym_server.storage.records import LeasedQuery
from surrogym_server.storage.sql import expiry
from surrogym_server.storage.sql.database import NOW, constant
from surrogym_server.storage.sql.rows import NAMED, append_event, hold, query_in, touch, unknown_surrogate
from surrogym_server.storage.sql.tables import leases, queries, surrogates

Returned = Literal["failed", "expired", "unbegun", "refused"]  # outcome of a lease that ended without an answer
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
# The value is a constant in the statement: with a parameter, PostgreSQL would not use the index of open leases.
IS_OPEN = leases.c.outcome == constant("open")
ENDED = sa.exists().where(leases.c.surrogate_id == surrogates.c.id, expiry.has_ended(leases, IS_OPEN))
SHARE = (
    sa.select(surrogates.c.id, surrogates.c.paused, NOW.label("now"), ENDED.label("has_ended"))
    .where(NAMED)
    .with_for_update(read=True, key_share=True)
)


def begin(
    connection: Connection, surrogate: Row[Any], rows: Sequence[Row[Any]], sampler: str, seconds: float
) -> list[LeasedQuery]:
    """Make leases of the queries in these rows, which the caller has locked, for one sampler."""
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
    connection.execute(NEW_LEASE, [_new(surrogate, query, sampler, seconds) for query in leased])
    connection.execute(LEASE_QUERIES, {"claimed": [query.id for query in leased], "claimer": sampler})
    return leased


def _new(surrogate: Row[Any], query: LeasedQuery, sampler: str, seconds: float) -> dict[str, Any]:
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


def of_query(connection: Connection, surrogate_id: int, query_id: int, token: str) -> Row[Any]:
    """Return the lease of a query with this token: (id, expires, outcome). The surrogate need not be locked.

    Raises:
        UnknownQuery: the surrogate has no such query.
        ForeignLease: the token was never given out for it.
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
    return UnknownQuery(f"expected a query of this surrogate, got {query_id}, which does not exist")


def foreign_lease(query_id: int) -> ForeignLease:
    return ForeignLease(f"expected a lease token of query {query_id}, got another token")


def set_outcome(connection: Connection, lease_ids: Sequence[int], outcome: str) -> None:
    connection.execute(SET_OUTCOME, {"ended": lease_ids, "how": outcome})


def share(connection: Connection, name: str) -> Row[Any]:
    """Lock a surrogate against deletion, without blocking writers. Returns (id, paused, now, has_ended).

    ``has_ended``: whether leases of its queries have expired. The caller then ends them, which blocks writers.
    """
    row = connection.execute(SHARE, {"named": name}).one_or_none()
    if row is None:
        raise unknown_surrogate(name)
    if row.has_ended:
        sweep(connection, hold(connection, name))
    return row


def sweep(connection: Connection, surrogate: Row[Any]) -> int:
    """End the surrogate's expired leases. Returns their number."""
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
    """Return leased queries to the queue, or set them aside after their last attempt or a refusal.

    A query has the same number of attempts each time it is requeued. A lease that ended before a real step does not
    count as an attempt. The leases already have their ``outcome``.
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
    """Whether a row of queries is a pending query of this surrogate that no sampler has begun."""
    begun = sa.select(leases.c.id).where(leases.c.query_id == queries.c.id, leases.c.outcome.not_in(BEFORE_A_STEP))
    return (queries.c.surrogate_id == surrogate_id) & (queries.c.status == "pending") & ~sa.exists(begun)


def requeue_set_aside(connection: Connection, surrogate: Row[Any]) -> int:
    """Make the queries that were set aside or refused pending, with as many attempts as a new query. Returns their
    number."""
    set_aside = (queries.c.surrogate_id == surrogate.id) & queries.c.status.in_(("set_aside", "refused"))
    return connection.execute(sa.update(queries).where(set_aside).values(status="pending")).rowcount
