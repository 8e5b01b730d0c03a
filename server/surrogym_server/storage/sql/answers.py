"""Which lease a reported sample answers, and what becomes of its query."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection, Row

from surrogym_server.errors import InvalidInput
from surrogym_server.storage.records import NewSample, Purpose
from surrogym_server.storage.sql.leases import foreign_lease, set_outcome, unknown_query
from surrogym_server.storage.sql.tables import leases, queries, samples


@dataclass(frozen=True)
class Answered:
    """The lease under which a sample was reported."""

    lease_id: int
    query_id: int
    purpose: Purpose
    attempt: int
    live: bool
    contested: bool  # another lease of the query is live
    sample_id: int | None  # what was reported under it before
    fingerprint: str | None


def read_answered(connection: Connection, held: Row[Any], batch: Sequence[NewSample]) -> list[Answered | None]:
    """For each sample the lease it was reported under, or None; locks their queries.

    Raises:
        UnknownQuery, ForeignLease: as ``Samples.add`` says.
    """
    named = {sample.query_id for sample in batch if sample.query_id is not None}
    purposes = _lock_queries(connection, held, named)
    by_token = _leases(connection, held, purposes)
    return [_lease_of(sample, purposes, by_token) for sample in batch]


def settle(connection: Connection, answered: Iterable[Answered]) -> None:
    """Note the leases as answered, and the queries that no live lease of another keeps."""
    leases_done = {one.lease_id: one for one in answered}
    if not leases_done:
        return
    set_outcome(connection, list(leases_done), "answered")
    done = [one.query_id for one in leases_done.values() if one.live or not one.contested]
    if done:
        update = sa.update(queries).where(queries.c.id.in_(done))
        connection.execute(update.values(status="answered", error=None))


def _lock_queries(connection: Connection, held: Row[Any], named: set[int]) -> dict[int, Purpose]:
    if not named:
        return {}
    wanted = (
        sa.select(queries.c.id, queries.c.purpose)
        .where(queries.c.surrogate_id == held.id, queries.c.id.in_(named))
        .order_by(queries.c.id)
        .with_for_update()
    )
    return {row.id: row.purpose for row in connection.execute(wanted)}


def _leases(connection: Connection, held: Row[Any], purposes: dict[int, Purpose]) -> dict[tuple[int, str], Answered]:
    """All leases of these queries, by query and token."""
    if not purposes:
        return {}
    live = ((leases.c.outcome == "open") & (leases.c.expires > held.now)).label("live")
    columns = (leases.c.id, leases.c.query_id, leases.c.token, leases.c.attempt, live)
    reported = samples.c.lease_id == leases.c.id
    rows = connection.execute(
        sa.select(*columns, samples.c.id.label("sample_id"), samples.c.fingerprint)
        .select_from(leases.outerjoin(samples, reported))
        .where(leases.c.query_id.in_(list(purposes)))
    ).all()
    live_ids = {row.query_id: row.id for row in rows if row.live}
    return {
        (row.query_id, row.token): Answered(
            lease_id=row.id,
            query_id=row.query_id,
            purpose=purposes[row.query_id],
            attempt=row.attempt,
            live=bool(row.live),
            contested=live_ids.get(row.query_id, row.id) != row.id,
            sample_id=row.sample_id,
            fingerprint=row.fingerprint,
        )
        for row in rows
    }


def _lease_of(
    sample: NewSample, purposes: dict[int, Purpose], by_token: dict[tuple[int, str], Answered]
) -> Answered | None:
    if sample.query_id is None:
        if sample.lease_token is not None:
            raise InvalidInput("expected a query_id beside lease_token, got none")
        return None
    if sample.query_id not in purposes:
        raise unknown_query(sample.query_id)
    lease = by_token.get((sample.query_id, sample.lease_token or ""))
    if lease is None:
        raise foreign_lease(sample.query_id)
    return lease
