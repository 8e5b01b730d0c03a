"""Bodies of requests: strict parsing of JSON, and descriptions for OpenAPI."""

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
LONG = 16 * 1024  # parsing a longer body, in bytes, takes over 0.5 ms; other requests may run before it
DEEPEST = 200  # largest number of nested levels that the parser jiter accepts
MOST_FIELDS = 64  # largest number of top-level fields of a body, because the error names each unknown one
SCHEMAS = "#/components/schemas/{model}"
BINARY: dict[str, Any] = {frames.MEDIA_TYPE: {"schema": {"type": "string", "format": "binary"}}}


class JsonRequest(Request):
    """A request whose JSON body is parsed by this module instead of by FastAPI."""

    async def json(self) -> Any:
        """Parse the body as JSON. Raises ``HTTPException`` 400 if that fails."""
        content = await self.body()
        await take_turn(self.scope, content)
        return parse(content)


async def take_turn(scope: Scope, content: bytes) -> None:
    """Before a long body is parsed, let the event loop serve other requests.

    At most one long body is parsed in an iteration of the event loop. A thread would not help, because the parser holds
    the global interpreter lock.
    """
    if len(content) > LONG:
        turn: asyncio.Lock = scope["app"].state.parsing
        async with turn:
            await asyncio.sleep(0)


def parse(content: bytes) -> Any:
    """Parse a JSON text.

    Raises:
        HTTPException: 400 if the text is not JSON in UTF-8, an object has a key twice, or there are too many nested
            levels or fields.
    """
    try:
        parsed = jiter.from_json(content, catch_duplicate_keys=True)
    except ValueError as error:
        raise HTTPException(
            400,
            f"the body: expected JSON in UTF-8 with each key once and at most {DEEPEST} levels; parsing stopped: "
            f"{error}",
        ) from None
    if isinstance(parsed, dict) and len(parsed) > MOST_FIELDS:
        raise HTTPException(400, f"the body: expected at most {MOST_FIELDS} fields, got {len(parsed)}")
    return parsed


def parse_as(model: type[M], content: bytes) -> M:
    """Parse the JSON body of a request, and validate it as an instance of ``model``.

    Raises:
        HTTPException: 400 if the body is not valid JSON.
        RequestValidationError: the body is not a valid instance of ``model``.
    """
    try:
        return model.model_validate(parse(content))
    except ValidationError as error:
        raise RequestValidationError(error.errors(include_url=False)) from error


def described(model: type[BaseModel], example: dict[str, Any]) -> dict[str, Any]:
    """Return the OpenAPI description of a body that may be JSON or a binary frame."""
    schema = model.model_json_schema(ref_template=SCHEMAS)
    content = {JSON: {"schema": schema, "example": example}, **BINARY}
    return {"requestBody": {"required": True, "content": content}}


def example(value: dict[str, Any]) -> Any:
    """Return FastAPI's declaration of a request body, with an example for the documentation."""
    return Body(openapi_examples={"example": {"value": value}})
