"""Samples as rows of their table."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection, Row

from surrogym_server.storage.records import NewSample, SamplePurpose, fingerprint
from surrogym_server.storage.sql.answers import Answered
from surrogym_server.storage.sql.rows import append_event
from surrogym_server.storage.sql.tables import samples

NEW_SAMPLES = sa.insert(samples).returning(samples.c.id, sort_by_parameter_order=True)


def insert_samples(connection: Connection, held: Row[Any], sampler: str, rows: list[dict[str, Any]]) -> list[int]:
    """Insert rows of samples and append the event. Returns their ids in order."""
    if not rows:
        return []
    ids = [int(id) for id in connection.execute(NEW_SAMPLES, rows).scalars()]
    late = sum(row["late"] for row in rows)
    append_event(connection, held, "sample", sampler=sampler, ids=ids, late=late)
    return ids


def row_of(
    held: Row[Any], sampler: str, sample: NewSample, lease: Answered | None = None, *, logged: bool = False
) -> dict[str, Any]:
    """A sample as a row of its table: an answer under a lease, a logged sample, or one by hand."""
    purpose: SamplePurpose = "logged" if logged else "manual"
    return {
        "surrogate_id": held.id,
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
        "created_at": held.now,
    }
