"""Routes of sessions, from their opening to their end; ``api.stepping`` is what happens in between."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter
from fastapi.responses import Response

from surrogym_server import convert
from surrogym_server.api import examples
from surrogym_server.api.auth import READ, TRAIN
from surrogym_server.api.body import example
from surrogym_server.api.door import DoorRoute
from surrogym_server.api.problems import documented
from surrogym_server.api.state import Use
from surrogym_shared.codes import Code
from surrogym_shared.wire import (
    OpenSession,
    SessionCoordinates,
    SessionList,
    SessionView,
    SubmitOccupancy,
    SubmittedOccupancy,
)

router = APIRouter(prefix="/v1", tags=["sessions"], route_class=DoorRoute)

SESSION_ERRORS = (Code.UNKNOWN_SESSION, Code.SESSION_EXPIRED, Code.INVALID_REQUEST)


@router.post(
    "/surrogates/{name}/sessions",
    status_code=201,
    summary="Open a virtual environment",
    dependencies=[TRAIN],
    responses=documented(
        Code.UNKNOWN_SURROGATE,
        Code.NO_MODEL,
        Code.NOT_INSTALLED,
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
    return convert.session_view(session, use.sessions.idle_seconds, use.sessions.replay)


@router.get(
    "/surrogates/{name}/sessions",
    summary="What the sessions do",
    dependencies=[READ],
    responses=documented(Code.UNKNOWN_SURROGATE, Code.INVALID_REQUEST),
)
async def list_sessions(name: str, use: Use) -> SessionList:
    """Those that are open: steps, imagined returns, and what the penalty took. Counted since this process started."""
    return SessionList(sessions=[convert.session_activity(activity) for activity in await use.sessions.activity(name)])


@router.get("/sessions/{id}", summary="One session", dependencies=[TRAIN], responses=documented(*SESSION_ERRORS))
async def get_session(id: str, use: Use) -> SessionView:
    """Its settings, the last seq answered, and the model version of each lane."""
    return convert.session_view(await use.sessions.get(id), use.sessions.idle_seconds, use.sessions.replay)


@router.get(
    "/sessions/{id}/coordinates",
    summary="Where the lanes are",
    dependencies=[TRAIN],
    responses=documented(*SESSION_ERRORS),
)
async def session_coordinates(id: str, use: Use) -> SessionCoordinates:
    """The coordinates of every lane, as the original environment can be set to them."""
    return convert.session_coordinates(await use.sessions.coordinates(id))


@router.delete(
    "/sessions/{id}",
    status_code=204,
    summary="Close a session",
    dependencies=[TRAIN],
    responses=documented(Code.INVALID_REQUEST),
)
async def close_session(id: str, use: Use) -> Response:
    """Closing one that has ended is harmless."""
    await use.sessions.close(id)
    return Response(status_code=204)


@router.post(
    "/sessions/{id}/occupancy",
    summary="Submit the visited states",
    dependencies=[TRAIN],
    responses=documented(*SESSION_ERRORS, Code.NOT_RESET, Code.UNKNOWN_SURROGATE, Code.NOT_INSTALLED),
)
async def submit_occupancy(
    id: str, body: Annotated[SubmitOccupancy, example(examples.OCCUPANCY)], use: Use
) -> SubmittedOccupancy:
    """Under a name, for ``improve`` to weigh by; says how well the model is known there. Only a session opened with
    ``occupancy`` collects them."""
    states, index = await use.sessions.submit_occupancy(id, body.checkpoint)
    return SubmittedOccupancy(checkpoint=body.checkpoint, states=states, confidence_index=index)
