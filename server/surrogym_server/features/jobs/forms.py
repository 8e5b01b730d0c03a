"""Conversion of jobs: requests to records, and records to replies."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from surrogym_server.convert.stored import read_stored
from surrogym_server.features.jobs.records import JobProgress, JobRecord, JobResult, LeasedJob
from surrogym_shared import wire

JOB = "a job"  # what error messages call a stored job


def claimed_job(job: LeasedJob | None, lease_seconds: float) -> wire.ClaimedJob:
    if job is None:
        return wire.ClaimedJob(job=None)
    fields = {"id": job.id, "attempt": job.attempt, "lease_token": job.token, "lease_seconds": lease_seconds}
    return read_stored(wire.ClaimedJob, JOB, {"job": {**fields, "task": job.task}})


def job_progress(state: wire.JobState | None) -> JobProgress | None:
    if state is None:
        return None
    curve = [point.model_dump(mode="json") for point in state.curve]
    return JobProgress(state.model_dump(mode="json", exclude={"curve"}), curve)


def job_result(body: wire.FinishJob) -> JobResult:
    return JobResult(body.status, body.error, body.version, body.evaluation)


def job_view(record: JobRecord) -> wire.JobView:
    return read_stored(wire.JobView, JOB, _fields(record))


def job_detail(record: JobRecord) -> wire.JobDetail:
    """Convert a stored job, with its learning curve so far, to the reply."""
    return read_stored(wire.JobDetail, JOB, {**_fields(record), "curve": record.curve})


def job_list(records: list[JobRecord], workers: Mapping[str, tuple[int, bool]]) -> wire.JobList:
    named = [
        wire.WorkerView(name=name, most_episodes=most, reference=reference)
        for name, (most, reference) in workers.items()
    ]
    return wire.JobList(jobs=[job_view(record) for record in records], workers=named)


def _fields(record: JobRecord) -> dict[str, Any]:
    names = ("id", "task", "status", "cancelling", "created_at", "finished_at", "worker", "attempts")
    ended = {name: getattr(record, name) for name in ("error", "version", "evaluation")}
    return {**{name: getattr(record, name) for name in names}, "begun_at": record.begun, **record.state, **ended}
