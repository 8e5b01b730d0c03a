"""Designs, priors and occupancies: leases of fits, the storage of a fit's result, and the
prior model and the visited states that a fit reads."""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import sqlalchemy as sa
from sqlalchemy.engine import Connection, Row

from surrogym_server.errors import BeyondBudget, LeaseExpired, TooLarge, UnknownSurrogate
from surrogym_server.storage.records import (
    JSON,
    OPEN_STATUSES,
    Array,
    FitLease,
    Granted,
    NewDesign,
    OccupancyRecord,
    PriorRecord,
    SurrogateRecord,
    fingerprint,
)
from surrogym_server.storage.sql import surrogates as surrogate_rows
from surrogym_server.storage.sql.database import NOW, Database, conflict_insert, constant, damaged
from surrogym_server.storage.sql.models import insert_model
from surrogym_server.storage.sql.queries import (
    IS_INCOMPLETE,
    begin_initial,
    insert_queries,
    queue_initial,
    spoken_for,
)
from surrogym_server.storage.sql.rows import append_event, checksum, find, hold, recall, remember, set_columns, touch
from surrogym_server.storage.sql.surrogates import NO_RIGHT
from surrogym_server.storage.sql.tables import occupancies, priors, queries, samples, surrogates
from surrogym_shared.nouns import Query
from surrogym_shared.states import COMPLETED, Phase

INTERRUPTED_SECONDS = 60.0  # if initial queries are incomplete for longer, the server that queued them has died
# SQL expressions for conditions on a row of the table of surrogates, such as IS_DUE, and for parts of such conditions.
OWN_QUERIES = sa.select(queries.c.id).where(queries.c.surrogate_id == surrogates.c.id)
OWN_SAMPLES = sa.select(samples.c.id).where(samples.c.surrogate_id == surrogates.c.id)
# The statuses are constants in the SQL text, because with parameters PostgreSQL would not use an index.
OPEN = [constant(status) for status in OPEN_STATUSES]
AWAITS_PRIOR = sa.exists(
    sa.select(priors.c.surrogate_id).where(priors.c.surrogate_id == surrogates.c.id, priors.c.blob.is_(None))
)
OPEN_QUERY = sa.exists(OWN_QUERIES.where(queries.c.status.in_(OPEN)))


_EXPIRES = surrogates.c.fit_expires
_SET_BACK = NOW + surrogates.c.fit_seconds < _EXPIRES  # the clock was set back, so the lease would last too long
# Whether a surrogate has to be fitted now: it has changed since its last fit, no server fits it, and it has no pending
# or leased query. After a new log was stored, it may have pending or leased queries.
IS_DUE = sa.and_(
    surrogates.c.paused.is_(False),
    surrogates.c.revision > surrogates.c.fitted_revision,
    _EXPIRES.is_(None) | (_EXPIRES <= NOW) | _SET_BACK,
    sa.exists(OWN_SAMPLES),
    ~AWAITS_PRIOR,
    ~OPEN_QUERY | (surrogates.c.logged_revision > surrogates.c.fitted_revision),
    ~IS_INCOMPLETE,
)
DUE = sa.select(surrogates.c.name).where(IS_DUE).order_by(surrogates.c.id)
IS_HOPELESS = sa.and_(
    surrogates.c.phase == constant("collecting"),
    surrogates.c.paused.is_(False),
    sa.exists(OWN_QUERIES.where(queries.c.status.in_([constant(status) for status in ("set_aside", "refused")]))),
    ~OPEN_QUERY,
    ~sa.exists(OWN_SAMPLES),
    ~IS_INCOMPLETE,
)
IS_UNBEGUN = sa.and_(
    surrogates.c.phase == constant("collecting"),
    surrogates.c.paused.is_(False),
    surrogates.c.budget > 0,
    ~sa.exists(OWN_QUERIES),
    ~sa.exists(OWN_SAMPLES),
    ~IS_INCOMPLETE,
)
INTERRUPTED = IS_INCOMPLETE & (surrogates.c.created_at < NOW - INTERRUPTED_SECONDS)
UNBEGUN = sa.select(surrogates.c.name).where(IS_UNBEGUN | INTERRUPTED).order_by(surrogates.c.id)
HOPELESS = sa.select(surrogates.c.name).where(IS_HOPELESS).order_by(surrogates.c.id)


class Designs:
    """The storage of designs. A server fits a model only while it holds the surrogate's lease for fits, which one
    server holds at a time."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def improve(
        self,
        name: str,
        queries: int | Query,
        *,
        checkpoint: str | None = None,
        key: str | None = None,
        raise_budget: bool = False,
    ) -> Granted:
        """Request that the next fit chooses further queries, even if the design has ended. A fit becomes due.

        Args:
            name: name of the surrogate.
            queries: number of real steps of these queries; or a query in which a policy acts, which is stored at once.
            checkpoint: name of the occupancy that weights the choice; None for no weights.
            key: idempotency key of the request.
            raise_budget: whether to raise the budget by the missing steps.

        Raises:
            BeyondBudget: the budget has fewer steps left, and ``raise_budget`` is False.
        """
        trial, steps = (queries, queries.steps) if isinstance(queries, Query) else (None, queries)
        body = fingerprint(steps, checkpoint, trial and (trial.policy, trial.actions))
        with self._database.write() as connection:
            surrogate = hold(connection, name)
            raised = recall(connection, surrogate, "ask", key, body)
            if raised is None:
                before = surrogate_rows.read(connection, name)
                raised = _to_raise(connection, before, steps, allowed=raise_budget)
                changes: dict[str, Any] = {"budget": before.budget + raised, "checkpoint": checkpoint}
                if trial is None:
                    changes["extra_queries"] = before.extra_queries + steps
                else:
                    if before.phase in COMPLETED:
                        changes["phase"] = "sampling"
                    insert_queries(connection, surrogate, [trial], "adaptive", before.round)
                touch(connection, surrogate, **changes)
                remember(connection, surrogate, "ask", key, body, raised)
            return Granted(surrogate_rows.read(connection, name), raised)

    def left(self, name: str) -> int:
        """Return the number of real steps that a surrogate's budget has left, at least 0.

        It is the budget minus the steps taken, the steps of unanswered queries (open or set aside), and the steps
        requested by ``improve`` and not chosen yet.
        """
        with self._database.read() as connection:
            return max(0, _unspoken(connection, surrogate_rows.read(connection, name)))

    def due(self) -> list[str]:
        """Return the names of the surrogates that have to be fitted now, oldest first.

        Such a surrogate has samples, no pending or leased query, and a change since its last fit (a sample, a query set
        aside, an ``improve``, another budget or target, a damaged model). After the import of a log, it may have
        pending or leased queries. It is not paused, does not wait for a prior, and no server holds the lease of its
        fit. A lease with more time left than its duration, because the clock was set back, counts as expired.
        """
        with self._database.read() as connection:
            return list(connection.execute(DUE).scalars())

    def hopeless(self) -> list[str]:
        """Return the names of surrogates whose design can't continue, oldest first.

        Such a surrogate is in phase ``collecting`` and not paused. It has no samples, and all its queries were refused
        by the environment, or set aside after repeated failures.
        """
        with self._database.read() as connection:
            return list(connection.execute(HOPELESS).scalars())

    def unbegun(self) -> list[str]:
        """Return the names of surrogates whose initial queries are missing, oldest first.

        There are two kinds. The first was created with a budget of 0 and has a larger budget now; it has no query or
        sample, is in phase ``collecting``, and is not paused. For the second, a crash interrupted ``Surrogates.create``
        at least a minute ago.
        """
        with self._database.read() as connection:
            return list(connection.execute(UNBEGUN).scalars())

    def ask_first(self, name: str, queries: Sequence[Query]) -> None:
        """Queue the missing initial queries of a surrogate, given all its initial queries. Does nothing if none is
        missing."""
        with self._database.write() as connection:
            surrogate = hold(connection, name)
            if connection.execute(
                sa.select(surrogates.c.id).where(surrogates.c.id == surrogate.id, IS_UNBEGUN)
            ).first():
                begin_initial(connection, surrogate, queries)
        queue_initial(self._database, name, queries)

    def begin(self, name: str, owner: str, seconds: float) -> FitLease | None:
        """Lease the fit of a surrogate to the server ``owner`` for ``seconds``; the phase becomes ``fitting``.

        Returns None if the surrogate is not due.
        """
        with self._database.write() as connection:
            surrogate = hold(connection, name)
            row = connection.execute(
                sa.select(surrogates.c.revision, surrogates.c.extra_queries, surrogates.c.checkpoint)
                .where(surrogates.c.id == surrogate.id)
                .where(IS_DUE)
            ).one_or_none()
            if row is None:
                return None
            lease = FitLease(name, secrets.token_urlsafe(16), *row, expires=surrogate.now + seconds)
            set_columns(
                connection, surrogate.id, fit_token=lease.token, fit_owner=owner, **_lasting(lease.expires, seconds)
            )
            surrogate_rows.update_phase(connection, surrogate, "fitting", None)
            return lease

    def renew(self, lease: FitLease, seconds: float) -> FitLease:
        """Extend the lease of a fit to ``seconds`` from now, even if it has expired but no other server has taken it.

        Raises:
            LeaseExpired: another server has taken the lease, or it was withdrawn.
        """
        with self._database.write() as connection:
            surrogate = _hold_right(connection, lease)
            renewed = replace(lease, expires=surrogate.now + seconds)
            set_columns(connection, surrogate.id, **_lasting(renewed.expires, seconds))
            return renewed

    def commit(self, lease: FitLease, design: NewDesign) -> int:
        """Store the result of a fit (model, state, phase, next queries), and end its lease. Return the model's version.

        The error of the design is cleared. The queries get the number of this round and the purpose ``adaptive``.
        Samples that arrived after ``begin`` make the next fit due.

        Raises:
            LeaseExpired: another server has taken the lease, or it was withdrawn.
        """
        with self._database.write() as connection:
            surrogate = _hold_right(connection, lease)
            version = insert_model(connection, surrogate, design.model)
            _finish(connection, surrogate, lease, design)
            insert_queries(connection, surrogate, design.queries, "adaptive", surrogate.round + 1, extra=design.extra)
            append_event(connection, surrogate, "phase", phase=design.phase, error=None)
            return version

    def abort(self, lease: FitLease, error: str | None) -> None:
        """End the lease of a fit without a result. Does nothing if the lease has ended.

        With an ``error``, the phase becomes ``failed``, and the next fit is due once the surrogate has changed since
        this fit began. With None, as at a shutdown, the fit stays due.
        """
        with self._database.write() as connection:
            try:
                surrogate = _hold_right(connection, lease)
            except (LeaseExpired, UnknownSurrogate):
                return
            changes = {} if error is None else {"fitted_revision": lease.revision}
            set_columns(connection, surrogate.id, **NO_RIGHT, **changes)
            surrogate_rows.update_phase(connection, surrogate, _phase_after(surrogate, error), error)


def _lasting(expires: float, seconds: float) -> dict[str, float]:
    return {"fit_expires": expires, "fit_seconds": seconds}


def _unspoken(connection: Connection, record: SurrogateRecord) -> int:
    """Return the number of real steps that the budget has left; negative if the budget was lowered, or if samplers
    reported more samples than it allows."""
    return record.budget - spoken_for(connection, record.id) - record.extra_queries


def _to_raise(connection: Connection, record: SurrogateRecord, queries: int, *, allowed: bool) -> int:
    """Return the increase of the budget that ``queries`` further real steps need.

    Raises ``BeyondBudget`` if an increase is needed and not ``allowed``.
    """
    unspoken = _unspoken(connection, record)
    missing = max(0, queries - unspoken)
    if missing and not allowed:
        raise BeyondBudget(
            f"expected at most {max(0, unspoken)} more real steps, which the budget of {record.name!r} "
            f"({record.budget} real steps) has left, got {queries}: a token of role admin may raise the budget "
            f"(surrogym change {record.name} --budget {record.budget + missing})"
        )
    return missing


def _hold_right(connection: Connection, lease: FitLease) -> Row[Any]:
    surrogate = hold(connection, lease.surrogate, surrogates.c.fit_token)
    if surrogate.fit_token != lease.token:
        raise LeaseExpired(
            f"this server may no longer store its fit of {lease.surrogate!r}, because its lease has ended: "
            "start the fit again"
        )
    return surrogate


def _finish(connection: Connection, surrogate: Row[Any], lease: FitLease, design: NewDesign) -> None:
    set_columns(
        connection,
        surrogate.id,
        **NO_RIGHT,
        state=design.state,
        phase=design.phase,
        error=None,
        round=surrogate.round + 1,
        fitted_revision=lease.revision,
        extra_queries=surrogates.c.extra_queries - lease.extra_queries,
    )


def _phase_after(surrogate: Row[Any], error: str | None) -> Phase:
    return "failed" if error is not None else surrogate_rows.resting_phase(surrogate.round)


class Priors:
    """The storage of priors: models that are known before the first real step, such as of a simulator.

    Each surrogate has at most one prior. While its design waits for a prior, no fit is due.
    """

    def __init__(self, database: Database) -> None:
        self._database = database

    def get(self, name: str) -> PriorRecord | None:
        """Return the description of a surrogate's prior, also if the design still waits for it; None if there is
        none."""
        with self._database.read() as connection:
            row = connection.execute(
                sa.select(priors.c.created_at, priors.c.about, priors.c.blob.is_(None).label("awaited")).where(
                    priors.c.surrogate_id == find(connection, name)
                )
            ).one_or_none()
        return None if row is None else PriorRecord(row.created_at, row.about, awaited=bool(row.awaited))

    def blob(self, name: str) -> bytes | None:
        """Return the file of a prior's model; None if it is not stored (yet).

        Raises ``Damaged`` if the file differs from the one that was stored.
        """
        with self._database.read() as connection:
            own = priors.c.surrogate_id == find(connection, name)
            row = connection.execute(sa.select(priors.c.blob, priors.c.checksum).where(own)).one_or_none()
        if row is None or row.blob is None:
            return None
        if checksum(row.blob) != row.checksum:
            raise damaged(
                f"the prior of {name!r} has changed since it was stored, as its checksum shows: store the prior again"
            )
        return bytes(row.blob)

    def put(self, name: str, blob: bytes, about: JSON) -> None:
        """Store a prior, which replaces an earlier one. ``blob`` is the file of its model, ``about`` its description.

        Adaptive queries without a real step so far are withdrawn, and a fit becomes due.
        """
        with self._database.write() as connection:
            self._store(connection, name, blob, about)

    def wait(self, name: str) -> None:
        """Let the design of a surrogate wait for a prior. Does nothing if it has one."""
        with self._database.write() as connection:
            own = priors.c.surrogate_id == hold(connection, name).id
            if connection.execute(sa.select(priors.c.surrogate_id).where(own)).first() is None:
                self._store(connection, name, None, {})

    def drop(self, name: str) -> bool:
        """Remove a surrogate's prior, or stop waiting for it. Return whether there was one. A fit becomes due."""
        with self._database.write() as connection:
            surrogate = hold(connection, name)
            own = priors.c.surrogate_id == surrogate.id
            if not connection.execute(sa.delete(priors).where(own)).rowcount:
                return False
            _plan_anew(connection, name)
            return True

    def _store(self, connection: Connection, name: str, blob: bytes | None, about: JSON) -> None:
        surrogate = hold(connection, name)
        columns = {"created_at": surrogate.now, "about": about, "blob": blob, "checksum": checksum(blob or b"")}
        insert = conflict_insert(connection, priors).values(surrogate_id=surrogate.id, **columns)
        connection.execute(insert.on_conflict_do_update(index_elements=["surrogate_id"], set_=columns))
        if blob is not None:
            _plan_anew(connection, name)


def _plan_anew(connection: Connection, name: str) -> None:
    """Withdraw queries that were chosen with another prior and without a real step so far, and make a fit due."""
    surrogate, before = hold(connection, name), surrogate_rows.read(connection, name)
    touch(connection, surrogate, **surrogate_rows.withdraw_unbegun(connection, surrogate, before, None))
    append_event(connection, surrogate, "phase", phase=before.phase, error=before.error)


MAX_CHECKPOINTS = 1_000  # largest number of occupancies (named sets of visited states) stored for a surrogate


class Occupancy:
    """The storage of occupancies: states that policies visited, by the name of a checkpoint."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def put(self, name: str, checkpoint: str, states: Array) -> None:
        """Store visited states (m, C) under the name ``checkpoint``, as the latest occupancy. States that were stored
        under this name before are replaced."""
        with self._database.write() as connection:
            surrogate = hold(connection, name)
            own = (occupancies.c.surrogate_id == surrogate.id, occupancies.c.checkpoint == checkpoint)
            connection.execute(sa.delete(occupancies).where(*own))
            others = sa.select(sa.func.count()).where(occupancies.c.surrogate_id == surrogate.id)
            if connection.execute(others).scalar_one() >= MAX_CHECKPOINTS:
                raise TooLarge(
                    f"expected at most {MAX_CHECKPOINTS} names for visited states (checkpoints) of {name!r}, got "
                    "one more: submit the states under one of the earlier names"
                )
            connection.execute(
                sa.insert(occupancies).values(
                    surrogate_id=surrogate.id,
                    checkpoint=checkpoint,
                    round=surrogate.round,
                    created_at=surrogate.now,
                    columns=states.shape[1],
                    states=states.ravel(),
                )
            )

    def get(self, name: str, checkpoint: str) -> OccupancyRecord | None:
        """Return the occupancy of a checkpoint; None if none is stored."""
        return self._newest(name, occupancies.c.checkpoint == checkpoint)

    def latest(self, name: str) -> OccupancyRecord | None:
        """Return the occupancy that was stored last; None if none is stored."""
        return self._newest(name, sa.true())

    def _newest(self, name: str, condition: sa.ColumnElement[bool]) -> OccupancyRecord | None:
        with self._database.read() as connection:
            own = occupancies.c.surrogate_id == find(connection, name)
            newest = sa.select(occupancies).where(own, condition).order_by(occupancies.c.id.desc()).limit(1)
            row = connection.execute(newest).one_or_none()
        if row is None:
            return None
        states = np.array(row.states).reshape(-1, row.columns)
        return OccupancyRecord(row.checkpoint, row.round, row.created_at, states)
