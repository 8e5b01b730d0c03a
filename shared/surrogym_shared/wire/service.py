"""Wire models of the server itself: health, access and events."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from surrogym_shared.wire.base import PROTOCOL, Reply, Role


class Health(Reply):
    status: Literal["ok"] = "ok"
    version: str
    protocol: int = PROTOCOL


class Ready(Reply):
    status: Literal["ready", "not_ready"]
    storage: str


class Access(Reply):
    """Role of the caller, and what it may do."""

    role: Role
    tokens: bool = Field(description="whether the server has any tokens; where it has none, everybody is admin")


class Event(Reply):
    """Server-sent event of a surrogate. Its ``id`` increases, so that a reader can continue with Last-Event-ID."""

    id: int
    kind: Literal["created", "queries", "sample", "fit", "phase", "set_aside", "ledger", "damaged", "policy", "job"]
    created_at: float
    body: dict[str, Any]
