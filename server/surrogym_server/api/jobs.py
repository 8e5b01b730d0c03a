"""Routes of jobs: people queue, look and cancel; trainer workers claim, report and finish."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path, Request

from surrogym_server import convert
from surrogym_server.api import examples
from surrogym_server.api.auth import READ, TRAIN
from surrogym_server.api.body import example
from surrogym_server.api.door import DoorRoute
from surrogym_server.api.problems import documented
from surrogym_server.api.state import Use
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

Number = Annotated[int, Path(ge=1, le=2**63 - 1)]
THERE = (Code.UNKNOWN_SURROGATE, Code.UNKNOWN_JOB, Code.INVALID_REQUEST)


@router.get(
    "/jobs",
    summary="All jobs",
    dependencies=[READ],
    responses=documented(Code.UNKNOWN_SURROGATE, Code.INVALID_REQUEST),
)
def list_all(name: str, use: Use) -> JobList:
    """Newest first, with the trainer workers that are connected."""
    return convert.job_list(*use.jobs.list(name))


@router.post(
    "/jobs",
    status_code=201,
    summary="Ask a worker for a training or an evaluation",
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
def add(name: str, body: Annotated[AddJob, example(examples.JOB)], use: Use) -> JobView:
    """A worker (``surrogym work``) runs it with code of its own: a task is numbers and words from fixed lists. An
    evaluation runs in the environment that the worker was started with, and only if the worker takes so many real
    episodes."""
    task, fields = body.task, body.task.model_dump(mode="json")
    if isinstance(task, TrainTask):
        return convert.job_view(use.jobs.train(name, fields, body.idempotency_key))
    return convert.job_view(use.jobs.evaluate(name, fields, task.real_episodes, body.idempotency_key))


@router.get("/jobs/{job_id}", summary="One job", dependencies=[READ], responses=documented(*THERE))
def get(name: str, job_id: Number, use: Use) -> JobDetail:
    """With the curve of its training so far."""
    return convert.job_detail(use.jobs.get(name, job_id))


@router.post("/jobs/{job_id}:cancel", summary="Cancel a job", dependencies=[TRAIN], responses=documented(*THERE))
def cancel(name: str, job_id: Number, use: Use) -> JobView:
    """One that waits ends at once. The worker of a running one stops at its next report, and stores the best policy
    so far."""
    return convert.job_view(use.jobs.cancel(name, job_id))


@router.post(
    "/jobs:claim",
    summary="Lease a job to run",
    dependencies=[TRAIN],
    responses=documented(Code.UNKNOWN_SURROGATE, Code.INVALID_REQUEST),
)
async def claim(
    name: str, body: Annotated[ClaimJob, example(examples.CLAIM_JOB)], request: Request, use: Use
) -> ClaimedJob:
    """To one worker only. While there is none the reply waits, at most ``wait_seconds``."""
    job = await use.jobs.claim(
        name, body.worker, body.most_episodes, body.lease_seconds, body.wait_seconds, request.is_disconnected
    )
    return convert.claimed_job(job, body.lease_seconds)


@router.post(
    "/jobs/{job_id}:report",
    summary="Keep a job, and say how far it is",
    dependencies=[TRAIN],
    responses=documented(*THERE, Code.LEASE_EXPIRED),
)
def report(
    name: str, job_id: Number, body: Annotated[ReportJob, example(examples.REPORT_JOB)], use: Use
) -> ReportedJob:
    """The heartbeat of a worker. The reply says whether it is to stop. Without reports the lease ends: a training goes
    to the next worker, an evaluation fails."""
    progress = convert.job_progress(body.state)
    return ReportedJob(cancel=use.jobs.report(name, job_id, body.lease_token, body.lease_seconds, progress))


@router.post(
    "/jobs/{job_id}:finish",
    summary="End a job",
    dependencies=[TRAIN],
    responses=documented(*THERE, Code.LEASE_EXPIRED),
)
def finish(name: str, job_id: Number, body: Annotated[FinishJob, example(examples.FINISH_JOB)], use: Use) -> JobView:
    """With the version of the policy that was stored. A repeat is harmless."""
    return convert.job_view(use.jobs.finish(name, job_id, body.lease_token, convert.job_result(body)))
