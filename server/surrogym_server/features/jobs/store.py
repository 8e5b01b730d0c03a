"""Storage of jobs and their leases, in one table."""

from __future__ import annotations

import secrets
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection, Row

from surrogym_server.errors import LeaseExpired, Overloaded, UnknownJob
from surrogym_server.features.jobs.records import (
    MAX_JOBS,
    MAX_OPEN,
    MAX_RUNS,
    SILENT,
    JobProgress,
    JobRecord,
    JobResult,
    LeasedJob,
    NewJob,
)
from surrogym_server.storage.records import fingerprint
from surrogym_server.storage.sql.database import NOW, Database
from surrogym_server.storage.sql.rows import (
    append_event,
    find,
    has_ended,
    hold,
    recall,
    remember,
    sweep_table,
)
from surrogym_server.storage.sql.tables import Id, Json, Word, checked, metadata, owner, row_id
from surrogym_shared.states import JobKind, JobStatus

jobs = checked(
    sa.Table(
        "jobs",
        metadata,
        row_id(),
        owner(),
        sa.Column("kind", Word("jobs.kind", JobKind), nullable=False),
        sa.Column("status", Word("jobs.status", JobStatus), nullable=False),
        sa.Column("task", Json("jobs.task"), nullable=False),
        sa.Column("episodes", sa.Integer, nullable=False),  # number of real episodes of an evaluation; 0 for a training
        sa.Column("created_at", sa.Double, nullable=False),
        sa.Column("attempts", sa.Integer, nullable=False),
        sa.Column("worker", sa.Text),
        sa.Column("token", sa.Text),  # token of the last lease
        sa.Column("begun", sa.Double),
        sa.Column("expires", sa.Double),
        sa.Column("seconds", sa.Double),  # duration of the lease at its last renewal
        sa.Column("cancelling", sa.Boolean, nullable=False),
        sa.Column("lost", sa.Boolean, nullable=False),  # whether the job ended because its lease expired
        sa.Column("finished_at", sa.Double),
        sa.Column("state", Json("jobs.state"), nullable=False),
        sa.Column("curve", Json("jobs.curve"), nullable=False),
        sa.Column("error", sa.Text),
        sa.Column("version", sa.Integer),  # version of the policy that the job stored or evaluated
        sa.Column("evaluation", Id),
        sa.Index(None, "surrogate_id", "status", "id"),
        sa.Index(None, "status", "expires"),
        sqlite_autoincrement=True,
    )
)

SHOWN = [
    getattr(jobs.c, name)
    for name in (
        *("id", "kind", "task", "status", "cancelling", "created_at", "begun", "finished_at", "worker", "attempts"),
        *("state", "error", "version", "evaluation"),
    )
]
RUNNING = jobs.c.status == "running"
OPEN = jobs.c.status.in_(("queued", "running"))


class Jobs:
    """Storage of the jobs of surrogates and their leases.

    When the lease of a training expires, the training is queued again, or fails after ``MAX_RUNS`` attempts. When the
    lease of an evaluation expires, the evaluation fails, because real steps may have been taken. When the lease of a
    job expires whose cancellation was requested, the job becomes cancelled.

    A worker whose lease has expired may continue as long as no other worker has claimed the job and it is not
    cancelled: the worker's next report makes the job running again, and its result is stored.

    An operation on a job that does not exist raises ``UnknownJob``.
    """

    def __init__(self, database: Database) -> None:
        self._database = database

    def add(self, name: str, new: NewJob, *, key: str | None = None) -> int:
        """Queue a job, once for each idempotency key, and return its id. Ended jobs beyond the newest ``MAX_JOBS`` are
        removed.

        Raises:
            Overloaded: the surrogate has ``MAX_OPEN`` queued or running jobs.
        """
        body = fingerprint(new.kind, new.task)
        with self._database.write() as connection:
            held = hold(connection, name)
            before: int | None = recall(connection, held, "job", key, body)
            if before is not None:
                return before
            _require_room(connection, held.id, name)
            own = {"surrogate_id": held.id, "created_at": held.now, "status": "queued", "attempts": 0}
            fresh: dict[str, Any] = {"cancelling": False, "lost": False, "state": {}, "curve": []}
            insert = sa.insert(jobs).values(**own, **fresh, **vars(new)).returning(jobs.c.id)
            id = int(connection.execute(insert).scalar_one())
            append_event(connection, held, "job", job=id, status="queued")
            remember(connection, held, "job", key, body, id)
            return id

    def claim(
        self, name: str, worker: str, most_episodes: int, seconds: float, *, reference: bool = False
    ) -> LeasedJob | None:
        """Lease to a worker the oldest queued job that it accepts. Return None if there is none.

        Args:
            name: name of the surrogate.
            worker: name of the worker.
            most_episodes: largest number of real episodes that the worker accepts.
            seconds: duration of the lease.
            reference: whether the worker has a reference controller, which some jobs need.

        First, expired leases are ended. A new lease clears the progress of an earlier one.
        """
        with self._database.read() as connection:  # a read first, so that waiting workers don't block writers
            own = jobs.c.surrogate_id == find(connection, name)
            waiting = (jobs.c.status == "queued") | has_ended(jobs, RUNNING)
            if not connection.execute(sa.select(sa.exists().where(own, waiting))).scalar():
                return None
        with self._database.write() as connection:
            held = hold(connection, name)
            _sweep(connection, held)
            fits = (jobs.c.surrogate_id == held.id) & (jobs.c.status == "queued") & (jobs.c.episodes <= most_episodes)
            rows = connection.execute(sa.select(*SHOWN).where(fits).order_by(jobs.c.id)).all()
            row = next((one for one in rows if reference or not one.task.get("reference")), None)
            if row is None:
                return None
            token = secrets.token_urlsafe(16)
            lease = {"token": token, "worker": worker, "seconds": seconds, "expires": held.now + seconds}
            begun = {"status": "running", "begun": held.now, "attempts": row.attempts + 1}
            cleared: dict[str, Any] = {"state": {}, "curve": [], "error": None}
            connection.execute(sa.update(jobs).where(jobs.c.id == row.id).values(**lease, **begun, **cleared))
            append_event(connection, held, "job", job=row.id, status="running", worker=worker)
            return LeasedJob(row.id, row.task, row.attempts + 1, token)

    def report(self, name: str, id: int, token: str, seconds: float, progress: JobProgress | None) -> bool:
        """Extend the lease of a job to ``seconds`` from now, and store its progress (None: keep the stored progress).

        Returns whether the worker has to stop.

        Raises:
            LeaseExpired: the job has ended, or another worker has leased it.
        """
        with self._database.write() as connection:
            surrogate = find(connection, name)
            alive = (jobs.c.token == token) & (OPEN | jobs.c.lost)
            lease = {"expires": NOW + seconds, "seconds": seconds}
            running = {"status": "running", "lost": False, "finished_at": None, "error": None}
            update = sa.update(jobs).where(_own(surrogate, id), alive)
            update = update.values(**lease, **running, **({} if progress is None else vars(progress)))
            cancelling = connection.execute(update.returning(jobs.c.cancelling)).scalar()
            if cancelling is None:
                _read(connection, surrogate, id)
                raise _ended(id)
            return bool(cancelling)

    def finish(self, name: str, id: int, token: str, result: JobResult) -> JobRecord:
        """End a job with its result. A repeat changes nothing.

        Raises:
            LeaseExpired: another worker has leased the job, or the job was cancelled while it was queued again.
        """
        with self._database.write() as connection:
            held = hold(connection, name)
            row = _read(connection, held.id, id)
            if row.token != token or (row.status == "cancelled" and not row.cancelling):
                raise _ended(id)
            if row.lost or row.status in ("queued", "running"):
                update = sa.update(jobs).where(jobs.c.id == id)
                connection.execute(update.values(finished_at=held.now, lost=False, **vars(result)))
                append_event(connection, held, "job", job=id, status=result.status)
            return _record(_read(connection, held.id, id))

    def cancel(self, name: str, id: int) -> JobRecord:
        """Cancel a queued job at once, or ask the worker of a running job to stop. An ended job does not change."""
        with self._database.write() as connection:
            held = hold(connection, name)
            row = _read(connection, held.id, id)
            if row.status == "queued":
                update = sa.update(jobs).where(jobs.c.id == id)
                connection.execute(update.values(status="cancelled", finished_at=held.now))
                append_event(connection, held, "job", job=id, status="cancelled")
            elif row.status == "running" and not row.cancelling:
                connection.execute(sa.update(jobs).where(jobs.c.id == id).values(cancelling=True))
                append_event(connection, held, "job", job=id, status="cancelling")
            return _record(_read(connection, held.id, id))

    def get(self, name: str, id: int) -> JobRecord:
        """Return a job with its learning curve."""
        with self._database.read() as connection:
            return _record(_read(connection, find(connection, name), id))

    def list(self, name: str) -> list[JobRecord]:
        """Return all jobs of a surrogate, newest first, without their learning curves."""
        with self._database.read() as connection:
            own = jobs.c.surrogate_id == find(connection, name)
            rows = connection.execute(sa.select(*SHOWN).where(own).order_by(jobs.c.id.desc()))
            return [JobRecord(**row._mapping) for row in rows]

    def sweep_expired(self) -> int:
        """End the expired leases of jobs of all surrogates, and return their number.

        A lease with more time left than its duration, because the clock was set back, is shortened to its duration.
        """
        return sweep_table(self._database, jobs, RUNNING, _sweep)


def _sweep(connection: Connection, held: Row[Any]) -> int:
    """End the expired leases of a surrogate's jobs, and return their number."""
    again = (jobs.c.kind == "train") & (jobs.c.attempts < MAX_RUNS) & ~jobs.c.cancelling
    status = sa.case((jobs.c.cancelling, "cancelled"), (again, "queued"), else_="failed")
    ended = connection.execute(
        sa.update(jobs)
        .where(jobs.c.surrogate_id == held.id, RUNNING, jobs.c.expires <= held.now)
        .values(
            status=status,
            error=SILENT,
            lost=~again,
            finished_at=sa.case((again, sa.null()), else_=held.now),
        )
        .returning(jobs.c.id, jobs.c.status)
    ).all()
    for row in sorted(ended):
        append_event(connection, held, "job", job=row.id, status=row.status, error=SILENT)
    return len(ended)


def _require_room(connection: Connection, surrogate: int, name: str) -> None:
    """Raise ``Overloaded`` if a surrogate has too many queued or running jobs; else remove its oldest ended jobs."""
    own = jobs.c.surrogate_id == surrogate
    waiting = sa.select(sa.func.count()).select_from(jobs).where(own, OPEN)
    if connection.execute(waiting).scalar_one() >= MAX_OPEN:
        raise Overloaded(
            f"expected at most {MAX_OPEN} queued and running jobs of {name!r}, got one more: cancel one, or wait until "
            "one has ended"
        )
    kept = sa.select(jobs.c.id).where(own, ~OPEN).order_by(jobs.c.id.desc()).limit(MAX_JOBS)
    connection.execute(sa.delete(jobs).where(own, ~OPEN, jobs.c.id.not_in(kept)))


def _own(surrogate: int, id: int) -> sa.ColumnElement[bool]:
    return (jobs.c.surrogate_id == surrogate) & (jobs.c.id == id)


def _read(connection: Connection, surrogate: int, id: int) -> Row[Any]:
    wanted: sa.Select[Any] = sa.select(*SHOWN, jobs.c.curve, jobs.c.token, jobs.c.lost).where(_own(surrogate, id))
    row = connection.execute(wanted).one_or_none()
    if row is None:
        raise UnknownJob(
            f"expected the id of a job of this surrogate, got {id}, which is not there: surrogym jobs lists them"
        )
    return row


def _record(row: Row[Any]) -> JobRecord:
    return JobRecord(**{name: value for name, value in row._mapping.items() if name not in ("token", "lost")})


def _ended(id: int) -> LeaseExpired:
    return LeaseExpired(f"the lease of job {id} has ended: the job has ended, or another worker has it; claim again")
