"""Leases of queries: how they begin, how they end, and which of them a reported sample answers.

The caller must have locked the surrogate (``rows.hold``) unless a docstring says otherwise. A lease has one answer: one
sample, or the first samples of a rollout. All samples of an answer come in one batch.
"""

from __future__ import annotations

import secrets
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import sqlalchemy as sa
from sqlalchemy.engine import Connection, Row

from surrogym_server.errors import ForeignLease, IdempotencyConflict, InvalidInput, UnknownQuery
from surrogym_server.storage.port import MAX_ATTEMPTS
from surrogym_server.storage.records import LeasedQuery, NewSample
from surrogym_server.storage.sql.database import NOW, constant
from surrogym_server.storage.sql.rows import NAMED, append_event, has_ended, hold, query_in, touch, unknown_surrogate
from surrogym_server.storage.sql.tables import leases, queries, samples, surrogates
from surrogym_shared.states import Purpose

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


def begin(
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
        sweep(connection, hold(connection, name))
    return row


def sweep(connection: Connection, surrogate: Row[Any]) -> int:
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
    """Make a surrogate's queries that were set aside or refused pending again, with all attempts. Return their
    number."""
    set_aside = (queries.c.surrogate_id == surrogate.id) & queries.c.status.in_(("set_aside", "refused"))
    return connection.execute(sa.update(queries).where(set_aside).values(status="pending")).rowcount


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
