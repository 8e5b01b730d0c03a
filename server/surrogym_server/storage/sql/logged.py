"""Logged samples: identified by their place in their log, and used by the design when the log is complete.

The digest of a log up to a sample is a hash of the digest before it and of the sample's numbers. The fingerprint of a
logged sample holds both digests, so a sample is found by everything that came before it. A log that equals a stored one
up to some place, and then differs from what follows there, is another log. It is stored whole, under other digests.

``logged_revision`` is the revision of the surrogate that has all of the last log. While a log is incomplete it is one
ahead of ``revision``, so that the call that completes it makes a fit due even if it brings no new sample.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate, pairwise
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection, Row

from surrogym_server.errors import InvalidInput
from surrogym_server.storage.records import AddedSamples, NewSample, fingerprint
from surrogym_server.storage.sql.answers import insert_samples, row_of
from surrogym_server.storage.sql.rows import touch
from surrogym_server.storage.sql.tables import samples, surrogates


def store_logged(
    connection: Connection, surrogate: Row[Any], sampler: str, batch: Sequence[NewSample], after: str | None
) -> AddedSamples:
    """Insert the new samples of one part of a log. ``after`` is the digest of the part before; None for the first.

    Raises:
        InvalidInput: a sample that names a query.
    """
    for index, sample in enumerate(batch):
        if sample.query_id is not None:
            raise InvalidInput(f"samples.{index}: expected a logged sample without a query_id, got {sample.query_id}")
    rows = [row_of(surrogate, sampler, sample, logged=True) for sample in batch]
    before = after or ""
    while True:
        chain = list(accumulate((row["fingerprint"] for row in rows), fingerprint, initial=before))
        links = [f"{one}:{other}" for one, other in pairwise(chain)]
        stored_ids = _stored_ids(connection, surrogate, links)
        old = next((place for place, link in enumerate(links) if link not in stored_ids), len(links))
        if old == len(links) or not _continued(connection, surrogate, chain[old]):
            break
        before = chain[old + 1]  # logs that continue in the same way from here share this digest
        if after is not None:
            return AddedSamples((), 0, restart=before)
    new = [row | {"fingerprint": link} for row, link in zip(rows[old:], links[old:], strict=True)]
    ids = [stored_ids[link] for link in links[:old]] + insert_samples(connection, surrogate, sampler, new)
    if new:
        _update(connection, surrogate, logged_revision=surrogates.c.revision + 1)
    return AddedSamples(tuple(ids), old, digest=chain[-1])


def complete_log(connection: Connection, surrogate: Row[Any]) -> None:
    """Make a fit due for the samples of a complete log."""
    ahead = sa.select(surrogates.c.logged_revision > surrogates.c.revision).where(surrogates.c.id == surrogate.id)
    if connection.execute(ahead).scalar():
        touch(connection, surrogate)


def _stored_ids(connection: Connection, surrogate: Row[Any], fingerprints: Sequence[str]) -> dict[str, int]:
    """Return the ids of stored logged samples with these fingerprints, by fingerprint."""
    same = samples.c.fingerprint.in_(set(fingerprints))
    statement = sa.select(samples.c.fingerprint, samples.c.id).where(samples.c.surrogate_id == surrogate.id, same)
    return {row.fingerprint: row.id for row in connection.execute(statement.where(samples.c.purpose == "logged"))}


def _continued(connection: Connection, surrogate: Row[Any], digest: str) -> bool:
    """Whether a stored sample continues the log that has this digest."""
    follows = samples.c.fingerprint.startswith(f"{digest}:")
    statement = sa.select(samples.c.id).where(samples.c.surrogate_id == surrogate.id, follows).limit(1)
    return connection.execute(statement).first() is not None


def _update(connection: Connection, surrogate: Row[Any], **changes: Any) -> None:
    connection.execute(sa.update(surrogates).where(surrogates.c.id == surrogate.id).values(**changes))
