"""Bodies that FastAPI does not read: their route, and what OpenAPI says of them."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any

from fastapi import Body, Request
from fastapi.responses import Response
from fastapi.routing import APIRoute
from pydantic import BaseModel
from starlette.types import ASGIApp, Receive, Scope, Send

from surrogym_server.api.door import Door, door_of
from surrogym_server.api.json_body import JSON
from surrogym_shared import frames

SCHEMAS = "#/components/schemas/{model}"
BINARY: dict[str, Any] = {frames.MEDIA_TYPE: {"schema": {"type": "string", "format": "binary"}}}


class LeanRoute(APIRoute):
    """A route on the path of every step: FastAPI describes it, and does not stand between it and the wire.

    Its endpoint takes an id and the request.
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


def described(model: type[BaseModel], example: dict[str, Any]) -> dict[str, Any]:
    """OpenAPI of a body that comes as JSON or as a frame."""
    schema = model.model_json_schema(ref_template=SCHEMAS)
    content = {JSON: {"schema": schema, "example": example}, **BINARY}
    return {"requestBody": {"required": True, "content": content}}


def example(value: dict[str, Any]) -> Any:
    """A body that FastAPI reads, with an example."""
    return Body(openapi_examples={"example": {"value": value}})
