"""Real steps, and their counts by purpose.

Samples are stored once, all or none of a batch, and never changed. Logged samples are identified by their position in
their log, and a fit uses them when the log is complete.

The digest of a log up to a sample is a hash of the previous digest and of the sample's values. The fingerprint of a
logged sample contains the digests before and after it, so it depends on all earlier samples of the log. A log that
begins like a stored log and then differs is stored completely, under other digests.

``logged_revision`` is the revision of the surrogate with which its last log was complete. While a log is incomplete, it
is ``revision`` + 1, so that the batch that completes the log makes a fit due even if it has no new sample.

The ledger caches the counts of samples in memory, because counting a million rows takes 0.3 s.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from itertools import accumulate, pairwise
from typing import Any

import numpy as np
import sqlalchemy as sa
from sqlalchemy.engine import Connection, Row

from surrogym_server.errors import IdempotencyConflict, InvalidInput
from surrogym_server.storage.records import (
    AddedSamples,
    Array,
    LedgerRecord,
    LogPart,
    NewSample,
    SampleRecord,
    fingerprint,
)
from surrogym_server.storage.sql.database import NOW, Database, constant, damaged
from surrogym_server.storage.sql.queries import Answered, insert_snapshots, read_answered, settle
from surrogym_server.storage.sql.rows import Span, append_event, find, hold, recall, remember, set_columns, touch
from surrogym_server.storage.sql.tables import evaluations, leases, queries, samples, surrogates
from surrogym_shared.nouns import RealSteps, Vector
from surrogym_shared.states import SamplePurpose

_COMPUTED: dict[str, sa.ColumnElement[Any]] = {
    "requested_coordinates": sa.case((queries.c.kind == "step", queries.c.coordinates)).label("requested_coordinates"),
    "trajectory": sa.case((queries.c.kind == "rollout", samples.c.lease_id)).label("trajectory"),
}
_NAMES = [field.name for field in fields(SampleRecord)]
_FIELDS = [_COMPUTED[name] if name in _COMPUTED else samples.c[name] for name in _NAMES]

NEW_SAMPLES = sa.insert(samples).returning(samples.c.id, sort_by_parameter_order=True)

Identity = tuple[int | None, int]


class Samples:
    """The storage of samples, which are never changed, and never lost after ``add`` has returned."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def add(
        self,
        name: str,
        sampler: str,
        samples: Sequence[NewSample],
        *,
        key: str | None = None,
        log: LogPart | None = None,
        at_bound: Sequence[bool] = (),
    ) -> AddedSamples:
        # Content hash, to be compared with that of an earlier request with the same idempotency key.
        """Store a batch of samples, all or none, and mark the queries that they answer. Committed when this returns.

        A sample gets the purpose of its query, or ``manual`` without a query. If the lease of its query has expired or
        failed, the sample is stored and marked as late. It still answers the query, unless the query is leased again.

        All samples under one lease are one answer, and come in one batch. The answer to a query of one step is one
        sample. The answer to a rollout has the samples with ``step`` 0, 1, ..., without gaps; they may be fewer than
        the query's ``steps``. A repeat of an answer adds nothing and gets the same ids.

        Samples of a ``log`` answer no query, and don't count towards the budget. A logged sample is identified by its
        values and by all earlier samples of its log. So a repeated or extended log adds only its new samples, and equal
        steps within a log are all stored. If a log begins like a stored log and a later part differs, it has to be sent
        again from its start: see ``AddedSamples.restart``. A fit becomes due only after the last part of a log.

        ``at_bound`` (n,) says of each of the n samples whether an entry of its action was at a bound, which the ledger
        counts as wear; empty: of none. It is ignored for a log.

        Raises:
            UnknownQuery: the surrogate has no such query.
            ForeignLease: a lease token is missing, or does not belong to the query.
            InvalidInput: a logged sample names a query, or an answer lacks a step or has more steps than the query.
            IdempotencyConflict: the same lease token or idempotency key came with other samples.
        """
        body = fingerprint(sampler, [_content(sample) for sample in samples] if key else [])
        with self._database.write() as connection:
            surrogate = hold(connection, name)
            if log is not None:  # logged samples are identified by their position in the log, not by a key
                added = store_logged(connection, surrogate, sampler, samples, log.after)
                if log.complete and added.restart is None:
                    complete_log(connection, surrogate)
                return added
            before: list[int] | None = recall(connection, surrogate, "add_samples", key, body)
            if before is not None:
                return AddedSamples(tuple(before), len(before))
            answers = read_answered(connection, surrogate, samples)
            added = _store(connection, surrogate, sampler, samples, answers, at_bound or [False] * len(samples))
            remember(connection, surrogate, "add_samples", key, body, added.ids)
            return added

    def arrays(self, name: str) -> RealSteps:
        """Return all samples of a surrogate as arrays, in order of arrival; of shape (0, 0) if there are none."""
        with self._database.read() as connection:
            rows = connection.execute(_raw_arrays(find(connection, name))).all()
        if not rows:
            none = np.zeros((0, 0))
            return RealSteps(none, none, none, np.zeros(0), np.zeros(0, dtype=np.bool_), ())
        q, u, q_next, reward, terminated, purpose = zip(*rows, strict=True)
        return RealSteps(
            coordinates=_matrix(q),
            action=_matrix(u),
            next_coordinates=_matrix(q_next),
            reward=np.array(reward, dtype=np.float64),
            terminated=np.array(terminated, dtype=np.bool_),
            purpose=tuple(purpose),
        )

    def page(self, name: str, after: int, limit: int) -> list[SampleRecord]:
        """Return up to ``limit`` samples with an id above ``after``, in order of their ids."""
        with self._database.read() as connection:
            own = samples.c.surrogate_id == find(connection, name)
            rows = connection.execute(
                sa.select(*_FIELDS)
                .select_from(samples.outerjoin(queries, samples.c.query_id == queries.c.id))
                .where(own, samples.c.id > after)
                .order_by(samples.c.id)
                .limit(limit)
            )
            return [SampleRecord(**row._mapping) for row in rows]

    def count(self, name: str) -> int:
        with self._database.read() as connection:
            own = samples.c.surrogate_id == find(connection, name)
            return int(connection.execute(sa.select(sa.func.count()).where(own)).scalar_one())

    def reward_range(self, name: str) -> tuple[float, float] | None:
        """Return the smallest and the largest reward of a surrogate's samples; None if there are no samples."""
        with self._database.read() as connection:
            extremes = sa.select(sa.func.min(samples.c.reward), sa.func.max(samples.c.reward))
            low, high = connection.execute(extremes.where(samples.c.surrogate_id == find(connection, name))).one()
            return None if low is None else (float(low), float(high))


def _store(
    connection: Connection,
    surrogate: Row[Any],
    sampler: str,
    batch: Sequence[NewSample],
    answers: Sequence[Answered | None],
    at_bound: Sequence[bool],
) -> AddedSamples:
    """Insert the new samples of a batch, and mark the queries that they answer.

    A sample that repeats the lease and step of a stored one is a duplicate. ``answers`` has the lease of each sample
    (None: no query), and ``at_bound`` whether an entry of its action was at a bound.
    """
    identities = [_identity(place, *pair) for place, pair in enumerate(zip(batch, answers, strict=True))]
    leases = [lease for lease in answers if lease]
    reported = {(lease.lease_id, step): sample for lease in leases for step, sample in lease.reported.items()}
    ids: dict[Identity, int] = {identity: sample.sample_id for identity, sample in reported.items()}
    prints: dict[Identity, str] = {identity: sample.fingerprint for identity, sample in reported.items()}
    new: dict[Identity, dict[str, Any]] = {}
    new_snapshots: dict[str, Vector] = {}
    for identity, sample, lease, bound in zip(identities, batch, answers, at_bound, strict=True):
        row = row_of(surrogate, sampler, sample, lease) | {"at_bound": bound}
        if prints.setdefault(identity, row["fingerprint"]) != row["fingerprint"]:
            raise IdempotencyConflict(
                f"expected the same sample as first reported for query {sample.query_id}, got another: a stored sample "
                "can't be changed"
            )
        if identity not in ids:
            new.setdefault(identity, row)
            new_snapshots |= {} if sample.snapshot is None else {sample.snapshot: sample.next_coordinates}
    ids |= dict(zip(new, insert_samples(connection, surrogate, sampler, list(new.values())), strict=True))
    insert_snapshots(connection, surrogate, new_snapshots)
    if new:
        touch(connection, surrogate)
    settle(connection, [lease for lease in leases if not lease.reported])
    return AddedSamples(tuple(ids[identity] for identity in identities), len(batch) - len(new))


def _content(sample: NewSample) -> dict[str, Any]:
    """Return what makes two samples equal: all but the seconds, which samples that were stored earlier don't have."""
    return {name: value for name, value in asdict(sample).items() if name != "seconds"}


def _identity(place: int, sample: NewSample, lease: Answered | None) -> Identity:
    """Return the identity of a sample in its batch: its lease and step, or its index if it has no lease."""
    return (lease.lease_id, sample.step) if lease else (None, place)


def _raw_arrays(surrogate_id: int) -> sa.Select[Any]:
    """Return the SELECT of all samples of a surrogate. Vectors are selected as bytes, which is faster than as Python
    floats."""
    vectors = (samples.c.coordinates, samples.c.action, samples.c.next_coordinates)
    raw: list[Any] = [sa.type_coerce(column, sa.LargeBinary()) for column in vectors]
    statement = sa.select(*raw, samples.c.reward, samples.c.terminated, samples.c.purpose)
    return statement.where(samples.c.surrogate_id == surrogate_id).order_by(samples.c.id)


def _matrix(rows: Sequence[bytes]) -> Array:
    """Convert n byte strings of k floats to a matrix (n, k)."""
    return np.frombuffer(b"".join(rows), dtype="<f8").reshape(len(rows), -1).astype(np.float64)


def insert_samples(connection: Connection, surrogate: Row[Any], sampler: str, rows: list[dict[str, Any]]) -> list[int]:
    """Insert rows of samples, append one event for them, and return their ids in order."""
    if not rows:
        return []
    ids = [int(id) for id in connection.execute(NEW_SAMPLES, rows).scalars()]
    late = sum(row["late"] for row in rows)
    append_event(connection, surrogate, "sample", sampler=sampler, ids=ids, late=late)
    return ids


def row_of(
    surrogate: Row[Any], sampler: str, sample: NewSample, lease: Answered | None = None, *, logged: bool = False
) -> dict[str, Any]:
    """Convert a sample to a row of the table of samples. The sample may answer a query (``lease``), or be
    ``logged``."""
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
        "at_bound": False,
        "coordinates": sample.coordinates,
        "action": sample.action,
        "next_coordinates": sample.next_coordinates,
        "reward": sample.reward,
        "terminated": sample.terminated,
        "truncated": sample.truncated,
        "observation": sample.observation,
        "next_observation": sample.next_observation,
        "seconds": sample.seconds,
        "fingerprint": fingerprint(_content(sample)),
        "created_at": surrogate.now,
    }


def store_logged(
    connection: Connection, surrogate: Row[Any], sampler: str, batch: Sequence[NewSample], after: str | None
) -> AddedSamples:
    """Insert the new samples of one batch of a log.

    ``after`` is the digest of the log up to the previous batch; None for the first batch.

    Raises:
        InvalidInput: a sample has a query id.
    """
    for index, sample in enumerate(batch):
        if sample.query_id is not None:
            raise InvalidInput(
                f"samples.{index}: expected no query_id, because the sample comes from a log, got {sample.query_id}: "
                "leave it out"
            )
    rows = [row_of(surrogate, sampler, sample, logged=True) for sample in batch]
    before = after or ""
    while True:
        chain = list(accumulate((row["fingerprint"] for row in rows), fingerprint, initial=before))
        links = [f"{one}:{other}" for one, other in pairwise(chain)]
        stored_ids = _stored_ids(connection, surrogate, links)
        old = next((place for place, link in enumerate(links) if link not in stored_ids), len(links))
        if old == len(links) or not _continued(connection, surrogate, chain[old]):
            break
        # The stored log continues differently, so this log gets digests of its own, computed from another start value.
        before = chain[old + 1]
        if after is not None:
            return AddedSamples((), 0, restart=before)
    new = [row | {"fingerprint": link} for row, link in zip(rows[old:], links[old:], strict=True)]
    ids = [stored_ids[link] for link in links[:old]] + insert_samples(connection, surrogate, sampler, new)
    if new:
        set_columns(connection, surrogate.id, logged_revision=surrogates.c.revision + 1)
    return AddedSamples(tuple(ids), old, digest=chain[-1])


def complete_log(connection: Connection, surrogate: Row[Any]) -> None:
    """Make a fit due for the samples of a log whose last batch was stored."""
    ahead = sa.select(surrogates.c.logged_revision > surrogates.c.revision).where(surrogates.c.id == surrogate.id)
    if connection.execute(ahead).scalar():
        touch(connection, surrogate)


def _stored_ids(connection: Connection, surrogate: Row[Any], fingerprints: Sequence[str]) -> dict[str, int]:
    """Return the ids of a surrogate's logged samples with these fingerprints, by fingerprint."""
    same = samples.c.fingerprint.in_(set(fingerprints))
    statement = sa.select(samples.c.fingerprint, samples.c.id).where(samples.c.surrogate_id == surrogate.id, same)
    return {row.fingerprint: row.id for row in connection.execute(statement.where(samples.c.purpose == "logged"))}


def _continued(connection: Connection, surrogate: Row[Any], digest: str) -> bool:
    """Whether a stored log has a sample directly after the position with this digest."""
    follows = samples.c.fingerprint.startswith(f"{digest}:")
    statement = sa.select(samples.c.id).where(samples.c.surrogate_id == surrogate.id, follows).limit(1)
    return connection.execute(statement).first() is not None


COUNTED = ("initial", "adaptive", "manual", "audit", "logged", "evaluation", "failed", "expired")
MOST_KEPT = 100_000  # largest number of surrogates whose numbers of samples are cached

FROM_RESET = sa.exists().where(
    queries.c.id == samples.c.query_id, queries.c.kind == "rollout", queries.c.snapshot.is_(None)
)
RESETS = sa.func.sum(sa.case(((samples.c.step == 0) & FROM_RESET, 1), else_=0))
WEAR = sa.func.sum(sa.case((samples.c.at_bound, 1), else_=0))
PURPOSE = sa.type_coerce(samples.c.purpose, sa.Text)  # read as text, because the column's type refuses unknown words
BY_PURPOSE: sa.Select[Any] = sa.select(
    samples.c.surrogate_id, PURPOSE, sa.func.count(), sa.func.max(samples.c.id), RESETS, WEAR
).group_by(samples.c.surrogate_id, samples.c.purpose)
# Largest number of surrogates in one statement, because SQLite limits the depth of an expression to 1,000.
COUNTED_AT_ONCE = 500
SINCE = BY_PURPOSE.where(samples.c.surrogate_id == sa.bindparam("owner"), samples.c.id > sa.bindparam("newest"))


@dataclass(frozen=True)
class SampleCounts:
    """Numbers of a surrogate's samples by purpose, and of its resets and wear, up to the sample with the id
    ``newest``. The keys of ``counts`` are fields of a ``LedgerRecord``."""

    newest: int = 0
    counts: Mapping[str, int] = field(default_factory=dict)


NONE = SampleCounts()


class CountedSamples:
    """Cache of the numbers of samples of each surrogate. A call counts only the samples added since the last call.

    This works because the ids of a surrogate's samples increase, and because samples are never changed, and only
    deleted with their surrogate. Other processes may add samples too.
    """

    def __init__(self) -> None:
        self._counts: dict[int, SampleCounts] = {}

    def of(self, connection: Connection, surrogate_id: int) -> SampleCounts:
        earlier = self._counts.get(surrogate_id, NONE)
        since = connection.execute(SINCE, {"owner": surrogate_id, "newest": earlier.newest})
        return self._add(surrogate_id, earlier, since)

    def of_many(self, connection: Connection, newest: Mapping[int, int | None]) -> dict[int, SampleCounts]:
        """Return the counts of several surrogates by a few SQL statements.

        ``newest`` has the id of each surrogate's newest sample, by surrogate id.
        """
        earlier = {id: self._counts.get(id, NONE) for id in newest}
        stale = [id for id, last in newest.items() if earlier[id].newest < (last or 0)]
        for first in range(0, len(stale), COUNTED_AT_ONCE):
            some = {id: earlier[id] for id in stale[first : first + COUNTED_AT_ONCE]}
            earlier |= self._count(connection, some)
        return earlier

    def _count(self, connection: Connection, earlier: Mapping[int, SampleCounts]) -> dict[int, SampleCounts]:
        since = [_is_since(id, counts) for id, counts in earlier.items() if counts.newest]
        new = samples.c.surrogate_id.in_([id for id, counts in earlier.items() if not counts.newest])
        rows: defaultdict[int, list[Sequence[Any]]] = defaultdict(list)
        for row in connection.execute(BY_PURPOSE.where(sa.or_(new, *since))):
            rows[row[0]].append(row)
        return {id: self._add(id, counts, rows[id]) for id, counts in earlier.items()}

    def _add(self, surrogate_id: int, earlier: SampleCounts, since: Iterable[Sequence[Any]]) -> SampleCounts:
        newest, counts = earlier.newest, dict(earlier.counts)
        for _, purpose, count, last, resets, wear in since:
            if purpose not in COUNTED:
                raise damaged(
                    f"expected one of {list(COUNTED)} in samples.purpose, got {purpose!r}; restore a copy of "
                    "the database"
                )
            for what, number in ((purpose, count), ("resets", resets), ("wear", wear)):
                counts[what] = counts.get(what, 0) + int(number)
            newest = max(newest, int(last))
        if len(self._counts) > MOST_KEPT:
            self._counts = {}
        counted = self._counts[surrogate_id] = SampleCounts(newest, counts)
        return counted


def _is_since(surrogate_id: int, counts: SampleCounts) -> sa.ColumnElement[bool]:
    return (samples.c.surrogate_id == surrogate_id) & (samples.c.id > counts.newest)


REPORT = "report_steps"
OF_LIMITS = ("violations", "fallbacks", "fallback_episodes")  # columns of evaluations with limits


BOUNDS: tuple[sa.BindParameter[int], sa.BindParameter[int]] = (sa.bindparam("first"), sa.bindparam("last"))


def _evaluations() -> sa.Select[Any]:
    summed = sa.select(
        evaluations.c.surrogate_id,
        constant("evaluation"),
        sa.type_coerce(sa.func.sum(evaluations.c.steps), sa.Integer()),
    )
    return summed.where(evaluations.c.surrogate_id.between(*BOUNDS)).group_by(evaluations.c.surrogate_id)


def _unresolved() -> sa.Select[Any]:
    """Return the SELECT of the numbers of steps under leases that failed or expired, by surrogate and outcome.

    Expired leases that are still marked as open count too. The conditions use an index, so that answered leases are not
    read; nearly all leases are answered.
    """
    failed, expired, is_open = constant("failed"), constant("expired"), constant("open")
    unswept = (leases.c.outcome == is_open) & (leases.c.expires <= NOW)
    has_no_answer = leases.c.outcome.in_((failed, expired, is_open)) & ((leases.c.outcome != is_open) | unswept)
    how = sa.case((leases.c.outcome == failed, failed), else_=expired).label("how")
    summed = sa.select(leases.c.surrogate_id, how, sa.type_coerce(sa.func.sum(queries.c.steps), sa.Integer()))
    own = summed.join_from(surrogates, leases, leases.c.surrogate_id == surrogates.c.id)
    join = own.join(queries, queries.c.id == leases.c.query_id)
    return join.where(surrogates.c.id.between(*BOUNDS), has_no_answer).group_by(leases.c.surrogate_id, how)


OTHERS = sa.union_all(_evaluations(), _unresolved())


class Ledger:
    """The counts of a surrogate's real steps by purpose."""

    def __init__(self, database: Database, counts: CountedSamples) -> None:
        self._database = database
        self._counted = counts

    def report(
        self,
        name: str,
        steps: int,
        *,
        key: str,
        episodes: int = 0,
        note: str = "",
        limits: Mapping[str, int] | None = None,
    ) -> LedgerRecord:
        """Add ``steps`` real steps of an evaluation of ``episodes`` episodes, once for each key. Return the counts of
        real steps by purpose. ``note`` is a text about the evaluation, and ``limits`` says how the episodes kept
        declared limits, by the columns ``OF_LIMITS``."""
        kept = dict(limits or {})
        body = fingerprint(steps, episodes, note, *([kept] if kept else []))
        fields = {"steps": steps, "episodes": episodes, "note": note, **kept}
        with self._database.write() as connection:
            surrogate = hold(connection, name)
            if recall(connection, surrogate, REPORT, key, body) is None:
                row = sa.insert(evaluations).values(surrogate_id=surrogate.id, created_at=surrogate.now, **fields)
                connection.execute(row)
                append_event(connection, surrogate, "ledger", purpose="evaluation", **fields)
                remember(connection, surrogate, REPORT, key, body, True)
            return self._read(connection, surrogate.id)

    def limited(self, name: str) -> dict[str, int]:
        """Return the sums of episodes, steps and ``OF_LIMITS`` of all reports with limits; empty if there is none."""
        columns = [evaluations.c[column] for column in ("episodes", "steps", *OF_LIMITS)]
        summed = sa.select(*(sa.func.sum(column) for column in columns)).where(evaluations.c.violations.is_not(None))
        with self._database.read() as connection:
            row = connection.execute(summed.where(evaluations.c.surrogate_id == find(connection, name))).one()
        return {} if row[0] is None else {c.name: int(total) for c, total in zip(columns, row, strict=True)}

    def read(self, name: str) -> LedgerRecord:
        with self._database.read() as connection:
            return self._read(connection, find(connection, name))

    def _read(self, connection: Connection, surrogate_id: int) -> LedgerRecord:
        sampled = {surrogate_id: self._counted.of(connection, surrogate_id).counts}
        return ledgers(connection, (surrogate_id, surrogate_id), sampled)[surrogate_id]


def ledgers(connection: Connection, span: Span, sampled: Mapping[int, Mapping[str, int]]) -> dict[int, LedgerRecord]:
    """Return the counts of real steps of the surrogates in a range of ids, by id. Surrogates without real steps are
    left out.

    Args:
        connection: connection to the database.
        span: first and last id of the surrogates.
        sampled: ``SampleCounts.counts`` by surrogate id.
    """
    rows = connection.execute(OTHERS, {"first": span[0], "last": span[1]}).all()
    of_surrogates: defaultdict[int, dict[str, int]] = defaultdict(dict)
    for surrogate, counts in sampled.items():
        of_surrogates[surrogate].update(counts)
    for surrogate, what, steps in rows:
        of_surrogates[surrogate][what] = int(steps)
    return {surrogate: _record(**counts) for surrogate, counts in of_surrogates.items()}


def _record(*, failed: int = 0, expired: int = 0, **steps: int) -> LedgerRecord:
    return LedgerRecord(**steps, unresolved=failed + expired, failed=failed)
