"""Descriptions of request bodies in OpenAPI."""

from __future__ import annotations

from typing import Any

from fastapi import Body
from pydantic import BaseModel

from surrogym_server.api.json_body import JSON
from surrogym_shared import frames

SCHEMAS = "#/components/schemas/{model}"
BINARY: dict[str, Any] = {frames.MEDIA_TYPE: {"schema": {"type": "string", "format": "binary"}}}


def described(model: type[BaseModel], example: dict[str, Any]) -> dict[str, Any]:
    """OpenAPI of a body that is accepted as JSON or as a frame."""
    schema = model.model_json_schema(ref_template=SCHEMAS)
    content = {JSON: {"schema": schema, "example": example}, **BINARY}
    return {"requestBody": {"required": True, "content": content}}


def example(value: dict[str, Any]) -> Any:
    """A body that FastAPI reads, with an example."""
    return Body(openapi_examples={"example": {"value": value}})
