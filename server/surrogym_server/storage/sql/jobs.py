"""Jobs and their leases, stored as rows of one table."""

from __future__ import annotations

import secrets
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection, Row

from surrogym_server.errors import LeaseExpired, Overloaded, UnknownJob, UnknownSurrogate
from surrogym_server.storage import jobs as port
from surrogym_server.storage.jobs import (
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
from surrogym_server.storage.sql import expiry
from surrogym_server.storage.sql.database import NOW, Database
from surrogym_server.storage.sql.rows import append_event, find, hold, recall, remember
from surrogym_server.storage.sql.tables import jobs, surrogates

SHOWN = [
    getattr(jobs.c, name)
    for name in (
        *("id", "kind", "task", "status", "cancelling", "created_at", "begun", "finished_at", "worker", "attempts"),
        *("state", "error", "version", "evaluation"),
    )
]
RUNNING = jobs.c.status == "running"
OPEN = jobs.c.status.in_(("queued", "running"))


class SqlJobs(port.Jobs):
    def __init__(self, database: Database) -> None:
        self._database = database

    def add(self, name: str, new: NewJob, *, key: str | None = None) -> int:
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
        with self._database.read() as connection:  # waiting workers don't block writers
            own = jobs.c.surrogate_id == find(connection, name)
            waiting = (jobs.c.status == "queued") | expiry.has_ended(jobs, RUNNING)
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
        with self._database.read() as connection:
            return _record(_read(connection, find(connection, name), id))

    def list(self, name: str) -> list[JobRecord]:
        with self._database.read() as connection:
            own = jobs.c.surrogate_id == find(connection, name)
            rows = connection.execute(sa.select(*SHOWN).where(own).order_by(jobs.c.id.desc()))
            return [JobRecord(**row._mapping) for row in rows]

    def sweep_expired(self) -> int:
        with self._database.read() as connection:
            owners = sa.select(jobs.c.surrogate_id).where(expiry.has_ended(jobs, RUNNING)).distinct()
            wanted = sa.select(surrogates.c.name).where(surrogates.c.id.in_(owners))
            names = [*connection.execute(wanted).scalars()]
            too_long = expiry.is_too_long(jobs, RUNNING)
            set_back = connection.execute(sa.select(sa.exists().where(too_long))).scalar()
        if set_back:
            with self._database.write() as connection:
                expiry.shorten(connection, jobs, RUNNING)
        return sum(self._sweep(name) for name in names)

    def _sweep(self, name: str) -> int:
        try:
            with self._database.write() as connection:
                return _sweep(connection, hold(connection, name))
        except UnknownSurrogate:  # deleted meanwhile
            return 0


def _sweep(connection: Connection, held: Row[Any]) -> int:
    """End the expired leases of the surrogate's jobs. Returns their number."""
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
    """Refuse a job if too many are queued or running, and remove the oldest jobs that have ended."""
    own = jobs.c.surrogate_id == surrogate
    waiting = sa.select(sa.func.count()).select_from(jobs).where(own, OPEN)
    if connection.execute(waiting).scalar_one() >= MAX_OPEN:
        most = f"expected at most {MAX_OPEN} jobs of {name!r} that wait or run"
        raise Overloaded(f"{most}, got one more: cancel one, or wait until one has ended")
    kept = sa.select(jobs.c.id).where(own, ~OPEN).order_by(jobs.c.id.desc()).limit(MAX_JOBS)
    connection.execute(sa.delete(jobs).where(own, ~OPEN, jobs.c.id.not_in(kept)))


def _own(surrogate: int, id: int) -> sa.ColumnElement[bool]:
    return (jobs.c.surrogate_id == surrogate) & (jobs.c.id == id)


def _read(connection: Connection, surrogate: int, id: int) -> Row[Any]:
    wanted: sa.Select[Any] = sa.select(*SHOWN, jobs.c.curve, jobs.c.token, jobs.c.lost).where(_own(surrogate, id))
    row = connection.execute(wanted).one_or_none()
    if row is None:
        raise UnknownJob(f"expected a job of this surrogate, got {id}, which is not there")
    return row


def _record(row: Row[Any]) -> JobRecord:
    return JobRecord(**{name: value for name, value in row._mapping.items() if name not in ("token", "lost")})


def _ended(id: int) -> LeaseExpired:
    return LeaseExpired(f"the lease of job {id} has ended: the job has ended, or another worker has it; claim again")
