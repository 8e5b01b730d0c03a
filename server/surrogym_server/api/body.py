"""Bodies that FastAPI does not read: their route, their JSON, and what OpenAPI says of them."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any, TypeVar

from fastapi import Body, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import Response
from fastapi.routing import APIRoute
from pydantic import BaseModel, ValidationError
from starlette.types import ASGIApp, Receive, Scope, Send

from surrogym_server.api.auth import Gate, bearer_token
from surrogym_shared import frames

M = TypeVar("M", bound=BaseModel)

JSON = "application/json"
BINARY: dict[str, Any] = {frames.MEDIA_TYPE: {"schema": {"type": "string", "format": "binary"}}}


class LeanRoute(APIRoute):
    """A route on the path of every step: FastAPI describes it, and does not stand between it and the wire.

    Its endpoint takes an id and the request. Only a token that may train gets there.
    """

    def __init__(self, path: str, endpoint: Callable[..., Awaitable[Response]], **options: Any) -> None:
        super().__init__(path, endpoint, **options)
        self.app = _lean(endpoint)


def _lean(endpoint: Callable[..., Awaitable[Response]]) -> ASGIApp:
    async def app(scope: Scope, receive: Receive, send: Send) -> None:
        request = Request(scope, receive)
        gate: Gate = scope["app"].state.gate
        gate.check(bearer_token(request.headers), ("train",))
        response = await endpoint(scope["path_params"]["id"], request)
        await response(scope, receive, send)

    return app


def parse_json(model: type[M], content: bytes) -> M:
    """A body, parsed and checked in one pass over its bytes.

    Raises:
        RequestValidationError: it is not a ``model``.
    """
    try:
        return model.model_validate_json(content)
    except ValidationError as error:
        raise RequestValidationError(error.errors(include_url=False)) from error


def described(model: type[BaseModel], example: dict[str, Any]) -> dict[str, Any]:
    """OpenAPI of a body that comes as JSON or as a frame."""
    content = {JSON: {"schema": model.model_json_schema(), "example": example}, **BINARY}
    return {"requestBody": {"required": True, "content": content}}


def example(value: dict[str, Any]) -> Any:
    """A body that FastAPI reads, with an example."""
    return Body(openapi_examples={"example": {"value": value}})
