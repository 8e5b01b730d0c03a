"""Routes of a surrogate's prior: describe, store, wait for, remove."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import Response

from surrogym_server.api.door import ADMIN, READ, DoorRoute
from surrogym_server.api.problems import documented
from surrogym_server.convert.stored import read_stored
from surrogym_server.feature import part
from surrogym_server.features.priors.service import PriorService
from surrogym_server.storage.records import PriorRecord
from surrogym_shared.codes import Code
from surrogym_shared.wire.priors import PriorAbout, PriorView

router = APIRouter(prefix="/v1/surrogates/{name}/prior", tags=["models"], route_class=DoorRoute)

FILE: dict[str, Any] = {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}
Priors = Annotated[PriorService, part(PriorService)]
THERE = (Code.UNKNOWN_SURROGATE, Code.INVALID_REQUEST)


@router.get("", summary="Describe the prior", dependencies=[READ], responses=documented(*THERE))
def get_prior(name: str, priors: Priors) -> PriorView:
    """Return the description of a surrogate's prior: its source, and how well its parameters were calibrated."""
    return _view(priors.get(name))


@router.put(
    "",
    summary="Store the prior",
    dependencies=[ADMIN],
    openapi_extra={"requestBody": {"required": True, "content": FILE}},
    responses=documented(*THERE, Code.TOO_LARGE, Code.NOT_INSTALLED),
)
async def put_prior(name: str, request: Request, priors: Priors) -> PriorView:
    """Store the prior of a surrogate: the body is a file of ``surrogym export`` with the same coordinates and actions.
    In the next fit, each output of the model learns the difference between the samples and the prior, if this predicts
    left-out samples better than learning without the prior. Adaptive queries without a real step so far are withdrawn,
    and the design chooses new ones."""
    data = await request.body()
    await run_in_threadpool(priors.put, name, data)
    return _view(await run_in_threadpool(priors.get, name))


@router.post(":await", summary="Wait for a prior", dependencies=[ADMIN], responses=documented(*THERE))
def wait_for_prior(name: str, priors: Priors) -> PriorView:
    """Let the design of a surrogate wait after its initial queries until a prior is stored. Does nothing if the
    surrogate has a prior."""
    priors.wait(name)
    return _view(priors.get(name))


@router.delete("", status_code=204, summary="Remove the prior", dependencies=[ADMIN], responses=documented(*THERE))
def delete_prior(name: str, priors: Priors) -> Response:
    """Remove the prior of a surrogate, or stop waiting for one. The next fit uses no prior."""
    priors.drop(name)
    return Response(status_code=204)


def _view(record: PriorRecord | None) -> PriorView:
    if record is None or record.awaited:
        return PriorView(awaited=record is not None)
    about = read_stored(PriorAbout, "the description of a prior", record.about)
    return PriorView(awaited=False, created_at=record.created_at, about=about)
