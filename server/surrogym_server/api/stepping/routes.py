"""Routes of reset, step and rollout, as JSON or binary frames, and of the stream of frames."""

from __future__ import annotations

import time
from collections.abc import Awaitable, Callable
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import Response
from fastapi.routing import APIRoute
from pydantic import BaseModel
from starlette.requests import ClientDisconnect
from starlette.routing import WebSocketRoute
from starlette.types import ASGIApp, Receive, Scope, Send

from surrogym_server.api import examples
from surrogym_server.api.door import BINARY, JSON, MEDIA_TYPE, TRAIN, Door, described, door_of, json_up_to, take_turn
from surrogym_server.api.problems import answer_to, documented
from surrogym_server.api.stepping import forms
from surrogym_server.api.stepping.forms import PARAMETER, seconds_left
from surrogym_server.api.stepping.stream import StepStream
from surrogym_server.convert import sessions
from surrogym_server.engine.port import SessionEngine
from surrogym_server.engine.requests import Advance
from surrogym_shared.codes import Code
from surrogym_shared.wire import ResetReply, ResetSession, RolloutReply, RolloutSession, StepReply, StepSession


class LeanRoute(APIRoute):
    """A fast route for steps: it is described by FastAPI, but its requests are not processed by FastAPI.

    The endpoint gets the session's id and the request.
    """

    def __init__(self, path: str, endpoint: Callable[..., Awaitable[Response]], **options: Any) -> None:
        super().__init__(path, endpoint, **options)
        self.app = _lean(door_of(self), endpoint)


def _lean(door: Door, endpoint: Callable[..., Awaitable[Response]]) -> ASGIApp:
    async def app(scope: Scope, receive: Receive, send: Send) -> None:
        door.admit(scope)
        response = await endpoint(scope["path_params"]["id"], Request(scope, receive))
        await response(scope, receive, send)

    return app


router = APIRouter(prefix="/v1/sessions/{id}", tags=["sessions"], route_class=LeanRoute)


class StreamRoute(WebSocketRoute):
    """The route of a WebSocket, which puts itself into the ASGI scope for the metrics, as HTTP routes do."""

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        scope["route"] = self
        await super().handle(scope, receive, send)


router.routes.append(StreamRoute("/v1/sessions/{id}/stream", StepStream()))

ERRORS = documented(
    Code.UNKNOWN_SESSION,
    Code.SESSION_EXPIRED,
    Code.INVALID_REQUEST,
    Code.SEQ_CONFLICT,
    Code.NOT_RESET,
    Code.TOO_LARGE,
    Code.UNSUPPORTED_MEDIA_TYPE,
    Code.TOO_MANY_REQUESTS,
    Code.DEADLINE_EXCEEDED,
    Code.UNAVAILABLE,
    Code.NOT_INSTALLED,
)


def _documented(body: type[BaseModel], example: dict[str, Any], reply: type[BaseModel], **extra: Any) -> dict[str, Any]:
    return {
        "response_model": reply,
        "dependencies": [TRAIN],
        "openapi_extra": {**described(body, example), "parameters": [PARAMETER], **extra},
        "responses": {200: {"content": BINARY}, **ERRORS},
    }


@router.post("/reset", summary="Start new episodes", **_documented(ResetSession, examples.RESET, ResetReply))
async def reset(id: str, request: Request) -> Response:
    """Begin new episodes in all lanes, or in those of ``mask``. With a seed, the lanes begin at episode 0 of this seed;
    without one, each lane begins its next episode."""
    return await _carried("reset", id, request)


@router.post("/step", summary="Step all lanes", **_documented(StepSession, examples.STEP, StepReply))
async def step(id: str, request: Request) -> Response:
    """Step all lanes, or those of ``mask``. A repeat with the same sequence number ``seq`` and the same body gets the
    same reply and takes no step, so a request whose reply was lost can be sent again, also over another transport."""
    return await _carried("step", id, request)


@router.post(
    "/rollout",
    summary="Step several times",
    **_documented(RolloutSession, examples.ROLLOUT, RolloutReply, **json_up_to(128)),
)
async def rollout(id: str, request: Request) -> Response:
    """Step several times in one request, with given actions or with those of a policy that is sent as arrays. Either
    all steps are taken or none."""
    return await _carried("rollout", id, request)


async def _carried(operation: forms.Operation, id: str, request: Request) -> Response:
    """Carry out a reset, step or rollout of the session with this id. The reply is JSON or a frame, like the
    request."""
    scope = request.scope
    media_type: str = scope[MEDIA_TYPE]
    engine: SessionEngine = scope["state"]["services"].engine
    limit, began = seconds_left(request.headers), time.monotonic()
    body = await _body(request)
    if media_type == JSON:
        await take_turn(scope, body)
        asked: Advance = forms.request_in_json(operation, id, body, _left(limit, began))
        return Response(await forms.carried_out(engine, asked, forms.AS_JSON), media_type=media_type)
    frame = forms.frame_of(operation, body)
    shape = sessions.session_shape(await engine.describe(id))
    asked = forms.request_in_frame(frame, id, shape, _left(limit, began))
    return Response(await forms.carried_out(engine, asked, forms.AS_FRAME), media_type=media_type)


def _left(limit: float | None, began: float) -> float | None:
    return None if limit is None else limit - (time.monotonic() - began)


async def _body(request: Request) -> bytes:
    """Read the body of a request, faster than ``Request.body`` does if the body comes in one message. Raises
    ``ClientDisconnect`` if the client disconnects before the end of the body."""
    parts = []
    while True:
        message = await request.receive()
        if message["type"] == "http.disconnect":
            raise ClientDisconnect
        parts.append(message.get("body", b""))
        if not message.get("more_body", False):
            return parts[0] if len(parts) == 1 else b"".join(parts)


class StepDoor:
    """Middleware that passes resets, steps and rollouts directly to their routes.

    It skips parts of FastAPI and Starlette that these routes don't need and that take as long as a small step: the
    handlers of exceptions, an exit stack, and the search through all routes.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app
        self._routes = {route.path.rpartition("/")[2]: route for route in router.routes if isinstance(route, APIRoute)}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        route, id = self._found(scope)
        if route is None:
            await self._app(scope, receive, send)
            return
        scope["route"], scope["path_params"] = route, {"id": id}
        try:
            await route.app(scope, receive, send)
        except Exception as error:
            response = await answer_to(Request(scope, receive), error)
            await response(scope, receive, send)

    def _found(self, scope: Scope) -> tuple[APIRoute | None, str]:
        if scope["type"] != "http" or scope["method"] != "POST":
            return None, ""
        parts = scope["path"].split("/")
        if len(parts) != 5 or parts[:3] != ["", "v1", "sessions"] or not parts[3]:
            return None, ""
        return self._routes.get(parts[4]), parts[3]
