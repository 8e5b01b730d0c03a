"""Routes of jobs: people queue, read and cancel jobs; trainer workers claim them, report progress and finish them.
Requests become records here, and records become replies."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Annotated, Any

from fastapi import APIRouter, Path, Request

from surrogym_server.api.door import READ, TRAIN, DoorRoute, example, require_present
from surrogym_server.api.problems import documented
from surrogym_server.convert.stored import read_stored
from surrogym_server.feature import part
from surrogym_server.features.jobs.records import JobProgress, JobRecord, JobResult, LeasedJob
from surrogym_server.features.jobs.service import JobService, Offer
from surrogym_shared import wire
from surrogym_shared.codes import Code
from surrogym_shared.wire import (
    AddJob,
    ClaimedJob,
    ClaimJob,
    FinishJob,
    JobDetail,
    JobList,
    JobView,
    ReportedJob,
    ReportJob,
    TrainTask,
)

router = APIRouter(prefix="/v1/surrogates/{name}", tags=["jobs"], route_class=DoorRoute)

Jobs = Annotated[JobService, part(JobService)]
Number = Annotated[int, Path(ge=1, le=2**63 - 1)]
THERE = (Code.UNKNOWN_SURROGATE, Code.UNKNOWN_JOB, Code.INVALID_REQUEST)

ADD = {"task": {"kind": "train", "algorithm": "fastppo", "steps": 100_000, "seed": 0}}
CLAIM = {"worker": "trainer-1", "most_episodes": 100, "wait_seconds": 20, "lease_seconds": 60}
REPORT = {
    "lease_token": "the token of the claim",
    "state": {
        "stage": "training",
        "share": 0.25,
        "steps": 2048,
        "total_steps": 8192,
        "imagined_return": -900.5,
        "curve": [{"steps": 1024, "imagined_return": -1200}, {"steps": 2048, "imagined_return": -900.5}],
    },
}
FINISH = {"lease_token": "the token of the claim", "status": "done", "version": 3}


@router.get(
    "/jobs",
    summary="List jobs and workers",
    dependencies=[READ],
    responses=documented(Code.UNKNOWN_SURROGATE, Code.INVALID_REQUEST),
)
def list_all(name: str, jobs: Jobs) -> JobList:
    """List the jobs of a surrogate, newest first, and the trainer workers that are connected."""
    return job_list(*jobs.list(name))


@router.post(
    "/jobs",
    status_code=201,
    summary="Queue a training or an evaluation",
    dependencies=[TRAIN],
    responses=documented(
        Code.UNKNOWN_SURROGATE,
        Code.UNKNOWN_POLICY,
        Code.NO_MODEL,
        Code.IDEMPOTENCY_CONFLICT,
        Code.TOO_MANY_REQUESTS,
        Code.INVALID_REQUEST,
    ),
)
def add(name: str, body: Annotated[AddJob, example(ADD)], jobs: Jobs) -> JobView:
    """Queue a training or an evaluation for a trainer worker (``surrogym work``). The task contains no code, only
    numbers and words from fixed lists. An evaluation runs in the original environment of a worker, and only a worker
    that accepts its number of real episodes gets it."""
    task, fields = body.task, body.task.model_dump(mode="json")
    if isinstance(task, TrainTask):
        return job_view(jobs.train(name, fields, body.idempotency_key))
    return job_view(jobs.evaluate(name, fields, task.real_episodes, body.idempotency_key))


@router.get("/jobs/{job_id}", summary="Describe a job", dependencies=[READ], responses=documented(*THERE))
def get(name: str, job_id: Number, jobs: Jobs) -> JobDetail:
    """Return a job with its learning curve so far."""
    return job_detail(jobs.get(name, job_id))


@router.post("/jobs/{job_id}:cancel", summary="Cancel a job", dependencies=[TRAIN], responses=documented(*THERE))
def cancel(name: str, job_id: Number, jobs: Jobs) -> JobView:
    """Cancel a job. A queued job ends at once. The worker of a running job stops at its next report, and stores the
    best policy so far."""
    return job_view(jobs.cancel(name, job_id))


@router.post(
    "/jobs:claim",
    summary="Lease a job to run",
    dependencies=[TRAIN],
    responses=documented(Code.UNKNOWN_SURROGATE, Code.INVALID_REQUEST, Code.TOO_MANY_REQUESTS),
)
async def claim(name: str, body: Annotated[ClaimJob, example(CLAIM)], request: Request, jobs: Jobs) -> ClaimedJob:
    """Lease the oldest queued job to a trainer worker. If none is queued, the reply waits for one, at most
    ``wait_seconds``."""
    offer = Offer(body.most_episodes, body.reference)
    present = partial(require_present, request)
    jobs.claims.require_room(request)
    with jobs.claims.count(request):
        job = await jobs.claim(name, body.worker, offer, body.lease_seconds, body.wait_seconds, present)
    return claimed_job(job, body.lease_seconds)


@router.post(
    "/jobs/{job_id}:report",
    summary="Report the progress of a job",
    dependencies=[TRAIN],
    responses=documented(*THERE, Code.LEASE_EXPIRED),
)
def report(name: str, job_id: Number, body: Annotated[ReportJob, example(REPORT)], jobs: Jobs) -> ReportedJob:
    """Renew the lease of a job and store its progress. ``cancel`` in the reply is true if the worker has to stop.
    Without reports the lease expires: a training is then queued again, and an evaluation fails."""
    progress = job_progress(body.state)
    return ReportedJob(cancel=jobs.report(name, job_id, body.lease_token, body.lease_seconds, progress))


@router.post(
    "/jobs/{job_id}:finish",
    summary="End a job",
    dependencies=[TRAIN],
    responses=documented(*THERE, Code.UNKNOWN_POLICY, Code.LEASE_EXPIRED),
)
def finish(name: str, job_id: Number, body: Annotated[FinishJob, example(FINISH)], jobs: Jobs) -> JobView:
    """End a job with its result, such as the version of the stored policy. A repeat changes nothing."""
    return job_view(jobs.finish(name, job_id, body.lease_token, job_result(body)))


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
