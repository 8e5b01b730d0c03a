"""Bodies: the fast path of the session routes, and what OpenAPI says of bodies that FastAPI does not read."""

from __future__ import annotations

from typing import Any, TypeVar

import msgspec
from fastapi import Body, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import Response
from pydantic import BaseModel, ValidationError
from starlette.exceptions import HTTPException

M = TypeVar("M", bound=BaseModel)

JSON = "application/json"


async def read_json(request: Request, model: type[M]) -> M:
    """The body, parsed and checked in one pass over its bytes.

    Raises:
        HTTPException: 415, the content type is not JSON.
        RequestValidationError: the body is not a ``model``.
    """
    content_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if content_type != JSON:
        raise HTTPException(415, f"expected content type {JSON}, got {content_type or 'none'}")
    try:
        return model.model_validate_json(await request.body())
    except ValidationError as error:
        raise RequestValidationError(error.errors(include_url=False)) from error


def write_json(reply: dict[str, Any]) -> Response:
    """A reply as it is, without a second check of what was just computed."""
    return Response(msgspec.json.encode(reply), media_type=JSON)


def described(model: type[BaseModel], example: dict[str, Any]) -> dict[str, Any]:
    """OpenAPI of a body that is read by ``read_json``."""
    content = {JSON: {"schema": model.model_json_schema(), "example": example}}
    return {"requestBody": {"required": True, "content": content}}


def example(value: dict[str, Any]) -> Any:
    """A body that FastAPI reads, with an example."""
    return Body(openapi_examples={"example": {"value": value}})
