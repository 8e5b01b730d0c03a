"""Routes of streams: append real steps, and read them."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query

from surrogym_server.api.door import READ, SAMPLE, DoorRoute, example, json_up_to
from surrogym_server.api.problems import documented
from surrogym_server.feature import part
from surrogym_server.features.watching.service import WatchingService
from surrogym_shared.codes import Code
from surrogym_shared.wire.watching import AddedSteps, AddSteps, StepPage, StreamedStep

router = APIRouter(prefix="/v1/surrogates/{name}/steps", tags=["samples"], route_class=DoorRoute)

Watching = Annotated[WatchingService, part(WatchingService)]
MOST_READ = 1_000
EXAMPLE = {
    "machine": "Pendulum-v1",
    "stream": "controller-7",
    "first": 0,
    "steps": [{"coordinates": [0.1, 0.0], "action": [0.5], "next_coordinates": [0.12, 0.4], "reward": -0.01}],
}


@router.post(
    "",
    summary="Append real steps to a stream",
    dependencies=[SAMPLE],
    openapi_extra=json_up_to(4_096),
    responses=documented(Code.UNKNOWN_SURROGATE, Code.IDEMPOTENCY_CONFLICT, Code.INVALID_REQUEST),
)
def add(name: str, body: Annotated[AddSteps, example(EXAMPLE)], watching: Watching) -> AddedSteps:
    """Append real steps of the machine to a stream, all or none, for ``surrogym watch``. No model learns them. They are
    stored when the reply comes. Steps that are stored already add nothing. Refused are gaps, steps of another machine
    or period, actions out of bounds, and values so far outside of their range that the unit must be another one."""
    stored, following = watching.add(name, body)
    return AddedSteps(stored=stored, next=following)


@router.get(
    "",
    summary="Read the steps of streams",
    dependencies=[READ],
    responses=documented(Code.UNKNOWN_SURROGATE, Code.INVALID_REQUEST),
)
def read(
    name: str,
    watching: Watching,
    after: Annotated[int, Query(ge=0, le=2**63 - 1, description="id of the last step that is known")] = 0,
    since: Annotated[
        float, Query(ge=0, allow_inf_nan=False, description="only later steps, in seconds since 1970")
    ] = 0,
    limit: Annotated[int, Query(ge=1, le=MOST_READ)] = MOST_READ,
) -> StepPage:
    """Read the steps of all streams of a surrogate, in the order in which they came. Only the newest 100,000 are
    kept."""
    return StepPage(steps=[StreamedStep(**step) for step in watching.page(name, after, since, limit)])
