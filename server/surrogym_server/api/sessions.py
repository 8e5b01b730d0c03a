"""Routes of sessions. reset, step and rollout are the path of every virtual step, so they read and write
bytes directly.

The binary frames and the stream of steps belong beside ``_JSON``: they differ from it in how a body becomes
the arguments of one ``SessionService`` call and how its ``Answer`` becomes bytes, and in nothing else.
"""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Request
from fastapi.responses import Response

from surrogym_server import convert
from surrogym_server.api import examples
from surrogym_server.api.auth import TRAIN
from surrogym_server.api.body import described, example, read_json, write_json
from surrogym_server.api.problems import documented
from surrogym_server.api.state import Use
from surrogym_shared.codes import Code
from surrogym_shared.wire import (
    OpenSession,
    ResetReply,
    ResetSession,
    RolloutReply,
    RolloutSession,
    SessionView,
    StepReply,
    StepSession,
    SubmitOccupancy,
    SubmittedOccupancy,
)

router = APIRouter(prefix="/v1", tags=["sessions"])

SESSION_ERRORS = (Code.UNKNOWN_SESSION, Code.SESSION_EXPIRED, Code.INVALID_REQUEST)
ADVANCE_ERRORS = documented(
    *SESSION_ERRORS, Code.SEQ_CONFLICT, Code.NOT_RESET, Code.TOO_LARGE, Code.UNSUPPORTED_MEDIA_TYPE
)


@router.post(
    "/surrogates/{name}/sessions",
    status_code=201,
    summary="Open a virtual environment",
    dependencies=[TRAIN],
    responses=documented(
        Code.UNKNOWN_SURROGATE,
        Code.NO_MODEL,
        Code.UNKNOWN_MODEL,
        Code.IDEMPOTENCY_CONFLICT,
        Code.TOO_MANY_REQUESTS,
        Code.TOO_LARGE,
        Code.INVALID_REQUEST,
    ),
)
async def open_session(name: str, body: Annotated[OpenSession, example(examples.OPEN)], use: Use) -> SessionView:
    """N lanes with a seed, a variant and an autoreset mode. The reply names the spaces and the seed."""
    session = await use.sessions.open(name, convert.opening(body))
    return convert.session_view(session, use.sessions.idle_seconds)


@router.get("/sessions/{id}", summary="One session", dependencies=[TRAIN], responses=documented(*SESSION_ERRORS))
async def get_session(id: str, use: Use) -> SessionView:
    """Its settings, the last seq answered, and the model version of each lane."""
    return convert.session_view(use.sessions.get(id), use.sessions.idle_seconds)


@router.delete(
    "/sessions/{id}",
    status_code=204,
    summary="Close a session",
    dependencies=[TRAIN],
    responses=documented(Code.INVALID_REQUEST),
)
async def close_session(id: str, use: Use) -> Response:
    """Closing one that has ended is harmless."""
    use.sessions.close(id)
    return Response(status_code=204)


@router.post(
    "/sessions/{id}/reset",
    summary="Start new episodes",
    response_model=ResetReply,
    dependencies=[TRAIN],
    openapi_extra=described(ResetSession, examples.RESET),
    responses=ADVANCE_ERRORS,
)
async def reset(id: str, request: Request, use: Use) -> Response:
    """In all lanes, or those of the mask. A seed starts them at episode 0; without one each goes on."""
    body = await read_json(request, ResetSession)
    answer = await use.sessions.reset(id, body.seq, body.seed, convert.lane_mask(body.mask))
    return write_json(convert.reset_reply(answer))


@router.post(
    "/sessions/{id}/step",
    summary="Step all lanes",
    response_model=StepReply,
    dependencies=[TRAIN],
    openapi_extra=described(StepSession, examples.STEP),
    responses=ADVANCE_ERRORS,
)
async def step(id: str, request: Request, use: Use) -> Response:
    """Or those of the mask. The same ``seq`` with the same body gets the same reply, so a lost one may be
    asked for again."""
    body = await read_json(request, StepSession)
    action = convert.numbers("action", body.action)
    answer = await use.sessions.step(id, body.seq, action, convert.lane_mask(body.mask), body.deviations)
    return write_json(convert.step_reply(answer))


@router.post(
    "/sessions/{id}/rollout",
    summary="Step several times",
    response_model=RolloutReply,
    dependencies=[TRAIN],
    openapi_extra=described(RolloutSession, examples.ROLLOUT),
    responses=ADVANCE_ERRORS,
)
async def rollout(id: str, request: Request, use: Use) -> Response:
    """With given actions, in one request; all steps or none."""
    body = await read_json(request, RolloutSession)
    answer = await use.sessions.rollout(id, body.seq, convert.numbers("actions", body.actions))
    return write_json(convert.rollout_reply(answer))


@router.post(
    "/sessions/{id}/occupancy",
    summary="Submit the visited states",
    dependencies=[TRAIN],
    responses=documented(*SESSION_ERRORS, Code.NOT_RESET),
)
async def submit_occupancy(
    id: str, body: Annotated[SubmitOccupancy, example(examples.OCCUPANCY)], use: Use
) -> SubmittedOccupancy:
    """Under a name, for ``improve`` to weigh by. Only a session opened with ``occupancy`` collects them."""
    states = await use.sessions.submit_occupancy(id, body.checkpoint)
    return SubmittedOccupancy(checkpoint=body.checkpoint, states=states)
