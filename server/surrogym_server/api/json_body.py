"""Bodies of requests: parsed strictly, at most one long one in a turn of the event loop; described in OpenAPI."""

from __future__ import annotations

import asyncio
from typing import Any, TypeVar

import jiter
from fastapi import Body, Request
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ValidationError
from starlette.exceptions import HTTPException
from starlette.types import Scope

from surrogym_shared import frames

M = TypeVar("M", bound=BaseModel)

JSON = "application/json"
LONG = 16 * 1024  # bytes; parsing them takes half a millisecond
DEEPEST = 200  # of jiter
MOST_FIELDS = 64  # of a body; each unknown one makes an error
SCHEMAS = "#/components/schemas/{model}"
BINARY: dict[str, Any] = {frames.MEDIA_TYPE: {"schema": {"type": "string", "format": "binary"}}}


class JsonRequest(Request):
    """A request whose body FastAPI reads with this module's parser."""

    async def json(self) -> Any:
        """Parse the body. Raises ``HTTPException`` 400, which FastAPI lets pass."""
        content = await self.body()
        await take_turn(self.scope, content)
        return parse(content)


async def take_turn(scope: Scope, content: bytes) -> None:
    """Wait until no other long body is parsed in this turn of the event loop, so that other requests are served in
    between.

    A thread would not help, because the parser holds the interpreter's lock.
    """
    if len(content) > LONG:
        turn: asyncio.Lock = scope["app"].state.parsing
        async with turn:
            await asyncio.sleep(0)


def parse(content: bytes) -> Any:
    """Parse a JSON text.

    Raises:
        HTTPException: 400 if it is not JSON in UTF-8, if an object has a key twice, or if it has too many levels or
            fields.
    """
    try:
        parsed = jiter.from_json(content, catch_duplicate_keys=True)
    except ValueError as error:
        expected = f"expected JSON in UTF-8 with each key once and at most {DEEPEST} levels"
        raise HTTPException(400, f"the body: {expected}; parsing stopped: {error}") from None
    if isinstance(parsed, dict) and len(parsed) > MOST_FIELDS:
        raise HTTPException(400, f"the body: expected at most {MOST_FIELDS} fields, got {len(parsed)}")
    return parsed


def parse_as(model: type[M], content: bytes) -> M:
    """Parse and validate a body.

    Raises:
        HTTPException: 400, like ``parse``.
        RequestValidationError: it is not a valid ``model``.
    """
    try:
        return model.model_validate(parse(content))
    except ValidationError as error:
        raise RequestValidationError(error.errors(include_url=False)) from error


def described(model: type[BaseModel], example: dict[str, Any]) -> dict[str, Any]:
    """OpenAPI of a body that is accepted as JSON or as a frame."""
    schema = model.model_json_schema(ref_template=SCHEMAS)
    content = {JSON: {"schema": schema, "example": example}, **BINARY}
    return {"requestBody": {"required": True, "content": content}}


def example(value: dict[str, Any]) -> Any:
    """A body that FastAPI reads, with an example."""
    return Body(openapi_examples={"example": {"value": value}})
