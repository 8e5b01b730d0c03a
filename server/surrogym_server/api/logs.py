"""Routes of logs: upload of recorded real steps as CSV text."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Request

from surrogym_server.api import examples
from surrogym_server.api.door import ADMIN, SAMPLE, ConcurrencyLimit, DoorRoute, example, json_up_to
from surrogym_server.api.problems import documented
from surrogym_server.api.state import Services, Use
from surrogym_server.convert import logs
from surrogym_server.services.samples import NOTHING
from surrogym_shared.codes import Code
from surrogym_shared.wire import AddedLog, AddLog, DraftedLog, DraftLog

router = APIRouter(prefix="/v1", tags=["logs"], route_class=DoorRoute)

KIBIBYTES = 5 * 1024  # largest JSON body with a log, in KiB


@router.post(
    "/logs:draft",
    summary="Draft a specification from a log",
    dependencies=[ADMIN],
    openapi_extra=json_up_to(KIBIBYTES),
    responses=documented(Code.INVALID_REQUEST, Code.TOO_LARGE, Code.TOO_MANY_REQUESTS),
)
async def draft(body: Annotated[DraftLog, example(examples.DRAFT_LOG)], request: Request) -> DraftedLog:
    """Check each row of a log, and draft a specification from the usable ones. Nothing is stored."""
    turns: ConcurrencyLimit = request.app.state.log_turns
    return await turns.take(request, lambda: logs.drafted_report(logs.drafted_log(body)))


@router.post(
    "/surrogates/{name}/logs",
    summary="Store the steps of a log",
    dependencies=[SAMPLE],
    openapi_extra=json_up_to(KIBIBYTES),
    responses=documented(Code.UNKNOWN_SURROGATE, Code.INVALID_REQUEST, Code.TOO_LARGE, Code.TOO_MANY_REQUESTS),
)
async def add(name: str, body: Annotated[AddLog, example(examples.ADD_LOG)], request: Request, use: Use) -> AddedLog:
    """Check each row of a log against the surrogate's specification, and store the usable rows as ``logged`` samples.
    With ``check_only`` nothing is stored. A repeat of a log adds only steps that are not stored yet."""
    turns: ConcurrencyLimit = request.app.state.log_turns
    return await turns.take(request, lambda: _added(name, body, use))


def _added(name: str, body: AddLog, use: Services) -> AddedLog:
    log = logs.checked_log(body, use.surrogates.spec(name))
    added = NOTHING if body.check_only else use.samples.add_log(name, logs.logged_samples(log), log.steps.origin)
    return logs.added_report(log, added)
