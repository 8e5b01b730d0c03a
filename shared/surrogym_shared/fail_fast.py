"""Base class of models of untrusted data, whose validation takes no longer than reading it."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, GetCoreSchemaHandler
from pydantic_core import CoreSchema

SEQUENCES = ("list", "tuple", "set", "frozenset")


def _stop_at_first(node: Any) -> None:
    if isinstance(node, dict):
        if node.get("type") in SEQUENCES:
            node["fail_fast"] = True
        for inner in node.values():
            _stop_at_first(inner)
    elif isinstance(node, list):
        for inner in node:
            _stop_at_first(inner)


class FailFast(BaseModel):
    """Model whose sequences are validated up to the first wrong entry.

    By default pydantic collects an error for each entry, and a hundred thousand wrong ones would take seconds.
    """

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        schema = handler(source)
        _stop_at_first(schema)
        return schema
