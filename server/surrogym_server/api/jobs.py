"""Routes of jobs: people queue, read and cancel jobs; trainer workers claim, report on and finish them."""

from __future__ import annotations

from functools import partial
from typing import Annotated

from fastapi import APIRouter, Path, Request

from surrogym_server import convert
from surrogym_server.api import examples
from surrogym_server.api.auth import READ, TRAIN
from surrogym_server.api.body import example
from surrogym_server.api.door import DoorRoute
from surrogym_server.api.problems import documented
from surrogym_server.api.state import Use
from surrogym_server.api.turns import require_present
from surrogym_server.services.activity import Offer
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
    """List all jobs, newest first, and the connected trainer workers."""
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
    """Queue a job for a trainer worker (``surrogym work``). A task consists of numbers and of words from fixed lists;
    all code is the worker's own. An evaluation runs in the environment that the worker was started with, if the worker
    accepts that many real episodes."""
    task, fields = body.task, body.task.model_dump(mode="json")
    if isinstance(task, TrainTask):
        return convert.job_view(use.jobs.train(name, fields, body.idempotency_key))
    return convert.job_view(use.jobs.evaluate(name, fields, task.real_episodes, body.idempotency_key))


@router.get("/jobs/{job_id}", summary="One job", dependencies=[READ], responses=documented(*THERE))
def get(name: str, job_id: Number, use: Use) -> JobDetail:
    """Return a job with the curve of its training so far."""
    return convert.job_detail(use.jobs.get(name, job_id))


@router.post("/jobs/{job_id}:cancel", summary="Cancel a job", dependencies=[TRAIN], responses=documented(*THERE))
def cancel(name: str, job_id: Number, use: Use) -> JobView:
    """Cancel a job. A queued job ends at once. The worker of a running job stops at its next report, and stores the
    best policy so far."""
    return convert.job_view(use.jobs.cancel(name, job_id))


@router.post(
    "/jobs:claim",
    summary="Lease a job to run",
    dependencies=[TRAIN],
    responses=documented(Code.UNKNOWN_SURROGATE, Code.INVALID_REQUEST, Code.TOO_MANY_REQUESTS),
)
async def claim(
    name: str, body: Annotated[ClaimJob, example(examples.CLAIM_JOB)], request: Request, use: Use
) -> ClaimedJob:
    """Lease the oldest queued job to this worker only. If there is none, the reply waits for one, up to
    ``wait_seconds``."""
    offer = Offer(body.most_episodes, body.reference)
    present = partial(require_present, request)
    request.app.state.job_claims.require_room(request)
    with request.app.state.job_claims.count(request):
        job = await use.jobs.claim(name, body.worker, offer, body.lease_seconds, body.wait_seconds, present)
    return convert.claimed_job(job, body.lease_seconds)


@router.post(
    "/jobs/{job_id}:report",
    summary="Report the progress of a job",
    dependencies=[TRAIN],
    responses=documented(*THERE, Code.LEASE_EXPIRED),
)
def report(
    name: str, job_id: Number, body: Annotated[ReportJob, example(examples.REPORT_JOB)], use: Use
) -> ReportedJob:
    """Renew the lease of a job and store its progress. The reply tells the worker whether to stop. Without reports the
    lease ends: a training then goes to the next worker, and an evaluation fails."""
    progress = convert.job_progress(body.state)
    return ReportedJob(cancel=use.jobs.report(name, job_id, body.lease_token, body.lease_seconds, progress))


@router.post(
    "/jobs/{job_id}:finish",
    summary="End a job",
    dependencies=[TRAIN],
    responses=documented(*THERE, Code.UNKNOWN_POLICY, Code.LEASE_EXPIRED),
)
def finish(name: str, job_id: Number, body: Annotated[FinishJob, example(examples.FINISH_JOB)], use: Use) -> JobView:
    """End a job, with the version of the policy that was stored. A repeat is harmless."""
    return convert.job_view(use.jobs.finish(name, job_id, body.lease_token, convert.job_result(body)))
