"""Logged samples: identified by their content, and used by the design when their log is complete.

``logged_revision`` is the revision of the surrogate that has all of the last log. While a log is incomplete it is one
ahead of ``revision``, so that the call that completes it makes a fit due even if it brings no new sample.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection, Row

from surrogym_server.errors import InvalidInput
from surrogym_server.storage.records import AddedSamples, NewSample
from surrogym_server.storage.sql.rows import touch
from surrogym_server.storage.sql.sample_rows import insert_samples, row_of
from surrogym_server.storage.sql.tables import samples, surrogates


def store_logged(connection: Connection, held: Row[Any], sampler: str, batch: Sequence[NewSample]) -> AddedSamples:
    """Insert the new samples of the batch: those that no logged sample of the surrogate equals in every number.

    Raises:
        InvalidInput: a sample that names a query.
    """
    for index, sample in enumerate(batch):
        if sample.query_id is not None:
            raise InvalidInput(f"samples.{index}: expected a logged sample without a query_id, got {sample.query_id}")
    rows = [row_of(held, sampler, sample, logged=True) for sample in batch]
    known = _known(connection, held, [row["fingerprint"] for row in rows])
    new = {row["fingerprint"]: row for row in rows if row["fingerprint"] not in known}
    known |= dict(zip(new, insert_samples(connection, held, sampler, list(new.values())), strict=True))
    if new:
        _update(connection, held, logged_revision=surrogates.c.revision + 1)
    return AddedSamples(tuple(known[row["fingerprint"]] for row in rows), len(batch) - len(new))


def complete_log(connection: Connection, held: Row[Any]) -> None:
    """Make a fit due for the samples of a complete log."""
    ahead = sa.select(surrogates.c.logged_revision > surrogates.c.revision).where(surrogates.c.id == held.id)
    if connection.execute(ahead).scalar():
        touch(connection, held)


def _known(connection: Connection, held: Row[Any], fingerprints: Sequence[str]) -> dict[str, int]:
    """The stored logged samples with these fingerprints, by fingerprint."""
    same = samples.c.fingerprint.in_(set(fingerprints))
    wanted = sa.select(samples.c.fingerprint, samples.c.id).where(samples.c.surrogate_id == held.id, same)
    return {row.fingerprint: row.id for row in connection.execute(wanted.where(samples.c.purpose == "logged"))}


def _update(connection: Connection, held: Row[Any], **changes: Any) -> None:
    connection.execute(sa.update(surrogates).where(surrogates.c.id == held.id).values(**changes))
