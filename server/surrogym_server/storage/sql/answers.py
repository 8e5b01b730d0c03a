"""Assignment of reported samples to leases, the effect on their queries, and samples as rows of their table.

A lease has one answer: one sample, or the first samples of a rollout. It comes whole, in one batch.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import sqlalchemy as sa
from sqlalchemy.engine import Connection, Row

from surrogym_server.errors import IdempotencyConflict, InvalidInput
from surrogym_server.storage.records import NewSample, fingerprint
from surrogym_server.storage.sql.leases import foreign_lease, set_outcome, unknown_query
from surrogym_server.storage.sql.rows import append_event
from surrogym_server.storage.sql.tables import leases, queries, samples
from surrogym_shared.states import Purpose, SamplePurpose

NAMED_QUERIES: sa.Select[Any] = (
    sa.select(queries.c.id, queries.c.purpose, queries.c.steps)
    .where(queries.c.surrogate_id == sa.bindparam("owner"), queries.c.id.in_(sa.bindparam("named", expanding=True)))
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
NEW_SAMPLES = sa.insert(samples).returning(samples.c.id, sort_by_parameter_order=True)


class Reported(NamedTuple):
    """A stored sample, to compare with one that is reported again."""

    sample_id: int
    fingerprint: str


@dataclass(frozen=True)
class Answered:
    """A lease under which samples were reported, with its query."""

    lease_id: int
    query_id: int
    purpose: Purpose
    steps: int  # most real steps that the query may take
    attempt: int
    live: bool
    contested: bool  # another lease of the query is live
    reported: dict[int, Reported]  # samples that are stored under this lease already, by step


def read_answered(connection: Connection, surrogate: Row[Any], batch: Sequence[NewSample]) -> list[Answered | None]:
    """Find the lease under which each sample was reported, or None. Locks their queries.

    Raises:
        UnknownQuery, ForeignLease, InvalidInput, IdempotencyConflict: as ``Samples.add`` says.
    """
    named = {sample.query_id for sample in batch if sample.query_id is not None}
    by_id = _lock_queries(connection, surrogate, named)
    by_token = _leases(connection, surrogate, by_id)
    answered = [_lease_of(sample, by_id, by_token) for sample in batch]
    steps: dict[int, set[int]] = defaultdict(set)
    for sample, lease in zip(batch, answered, strict=True):
        if lease is not None:
            steps[lease.lease_id].add(sample.step)
    for lease in {lease.lease_id: lease for lease in answered if lease}.values():
        _check_steps(lease, steps[lease.lease_id])
    return answered


def settle(connection: Connection, answered: Iterable[Answered]) -> None:
    """Mark leases as answered, and their queries too, except a query of which another lease is live."""
    leases_done = {one.lease_id: one for one in answered}
    if not leases_done:
        return
    set_outcome(connection, list(leases_done), "answered")
    query_ids = [one.query_id for one in leases_done.values() if one.live or not one.contested]
    if query_ids:
        connection.execute(ANSWER, {"done": query_ids})


def _check_steps(lease: Answered, steps: set[int]) -> None:
    """Raise an error if a lease's answer lacks a step, has too many, or has more steps than when first reported."""
    if lease.reported:
        if more := steps - lease.reported.keys():
            raise IdempotencyConflict(
                f"expected the {len(lease.reported)} samples first reported for query {lease.query_id}, "
                f"got step {min(more)} in addition"
            )
    elif steps != set(range(len(steps))) or len(steps) > lease.steps:
        raise InvalidInput(
            f"expected steps 0, 1, ... of query {lease.query_id}, at most {lease.steps}, got {sorted(steps)}"
        )


def _lock_queries(connection: Connection, surrogate: Row[Any], named: set[int]) -> dict[int, Row[Any]]:
    if not named:
        return {}
    return {row.id: row for row in connection.execute(NAMED_QUERIES, {"owner": surrogate.id, "named": list(named)})}


def _leases(connection: Connection, surrogate: Row[Any], by_id: dict[int, Row[Any]]) -> dict[tuple[int, str], Answered]:
    """Read all leases of these queries, by query id and token."""
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
    """Return the samples stored under each of these leases, by step."""
    reported: dict[int, dict[int, Reported]] = defaultdict(dict)
    for lease_id, step, *stored in connection.execute(REPORTED, {"reported": lease_ids}):
        reported[lease_id][step] = Reported(*stored)
    return reported


def _lease_of(
    sample: NewSample, by_id: dict[int, Row[Any]], by_token: dict[tuple[int, str], Answered]
) -> Answered | None:
    if sample.query_id is None:
        if sample.lease_token is not None:
            raise InvalidInput("expected a query_id beside lease_token, got none")
        return None
    if sample.query_id not in by_id:
        raise unknown_query(sample.query_id)
    lease = by_token.get((sample.query_id, sample.lease_token or ""))
    if lease is None:
        raise foreign_lease(sample.query_id)
    return lease


def insert_samples(connection: Connection, surrogate: Row[Any], sampler: str, rows: list[dict[str, Any]]) -> list[int]:
    """Insert rows of samples and append the event. Returns their ids in order."""
    if not rows:
        return []
    ids = [int(id) for id in connection.execute(NEW_SAMPLES, rows).scalars()]
    late = sum(row["late"] for row in rows)
    append_event(connection, surrogate, "sample", sampler=sampler, ids=ids, late=late)
    return ids


def row_of(
    surrogate: Row[Any], sampler: str, sample: NewSample, lease: Answered | None = None, *, logged: bool = False
) -> dict[str, Any]:
    """Convert a sample to a row of its table. It may be an answer under a lease, logged, or reported by hand."""
    purpose: SamplePurpose = "logged" if logged else "manual"
    return {
        "surrogate_id": surrogate.id,
        "query_id": lease.query_id if lease else None,
        "lease_id": lease.lease_id if lease else None,
        "purpose": lease.purpose if lease else purpose,
        "sampler": sampler,
        "attempt": lease.attempt if lease else 0,
        "step": sample.step,
        "late": lease is not None and not lease.live,
        "coordinates": sample.coordinates,
        "action": sample.action,
        "next_coordinates": sample.next_coordinates,
        "reward": sample.reward,
        "terminated": sample.terminated,
        "truncated": sample.truncated,
        "observation": sample.observation,
        "next_observation": sample.next_observation,
        "fingerprint": fingerprint(asdict(sample)),
        "created_at": surrogate.now,
    }
