"""Routes that open, describe and close sessions and submit visited states; ``api.stepping`` has reset and step."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter
from fastapi.responses import Response

from surrogym_server.api import examples
from surrogym_server.api.door import READ, TRAIN, DoorRoute, example, json_up_to
from surrogym_server.api.problems import documented
from surrogym_server.api.state import Use
from surrogym_server.convert import sessions
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
    openapi_extra=json_up_to(128),
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
    """Open a session: a virtual environment with N lanes, a seed, a variant and an autoreset mode. The reply has the
    observation and action spaces and the seed."""
    session = await use.sessions.open(name, sessions.opening(body))
    return sessions.session_view(session, use.engine.idle_seconds, use.engine.replay)


@router.get(
    "/surrogates/{name}/sessions",
    summary="List open sessions",
    dependencies=[READ],
    responses=documented(Code.UNKNOWN_SURROGATE, Code.INVALID_REQUEST),
)
async def list_sessions(name: str, use: Use) -> SessionList:
    """List the open sessions of a surrogate, with the virtual steps, imagined returns and penalties of each, counted
    since the server started."""
    return SessionList(sessions=[sessions.session_activity(activity) for activity in await use.sessions.activity(name)])


@router.get("/sessions/{id}", summary="Describe a session", dependencies=[TRAIN], responses=documented(*SESSION_ERRORS))
async def get_session(id: str, use: Use) -> SessionView:
    """Return a session's options, the last sequence number that was answered, and the model version of each lane."""
    return sessions.session_view(await use.sessions.get(id), use.engine.idle_seconds, use.engine.replay)


@router.get(
    "/sessions/{id}/coordinates",
    summary="Coordinates of the lanes",
    dependencies=[TRAIN],
    responses=documented(*SESSION_ERRORS),
)
async def session_coordinates(id: str, use: Use) -> SessionCoordinates:
    """Return the present coordinates of each lane. An original environment that can be set to any state can be set to
    these."""
    return sessions.session_coordinates(await use.engine.coordinates(id))


@router.delete(
    "/sessions/{id}",
    status_code=204,
    summary="Close a session",
    dependencies=[TRAIN],
    responses=documented(Code.INVALID_REQUEST),
)
async def close_session(id: str, use: Use) -> Response:
    """Close a session. Does nothing if the session has ended already."""
    await use.engine.close(id)
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
    """Store the states that a session has visited, under the name ``checkpoint``. ``improve`` can then choose queries
    near these states. The reply has the model's confidence index over them. The session must have been opened with the
    option ``occupancy``, which records visited states."""
    states, index = await use.sessions.submit_occupancy(id, body.checkpoint)
    return SubmittedOccupancy(checkpoint=body.checkpoint, states=states, confidence_index=index)
