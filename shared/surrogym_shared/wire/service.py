"""Wire models of the server itself: health, access and events."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from surrogym_shared.states import EventKind
from surrogym_shared.wire.base import PROTOCOL, Reply, Role


class Health(Reply):
    """Reply of a server that runs."""

    status: Literal["ok"] = "ok"
    version: str = Field(description="version of Surrogym")
    protocol: int = Field(default=PROTOCOL, description="version of the protocol; a client needs the same")


class Ready(Reply):
    """Reply that says whether the server can store data."""

    status: Literal["ready", "not_ready"] = Field(
        description="``ready``: the tables exist, and a small write was durable"
    )
    storage: str = Field(description="``ok`` if the storage works")


class Access(Reply):
    """Role of the caller, and what it may do."""

    role: Role = Field(description="role of the caller's token")
    tokens: bool = Field(description="whether the server has tokens; without any, everybody is admin")


class Event(Reply):
    """Server-sent event of a surrogate. Its ``id`` increases, so that a reader can continue with Last-Event-ID."""

    id: int = Field(description="number of the event")
    kind: EventKind = Field(description="kind of the event")
    created_at: float = Field(description="when it happened, in seconds since 1970, by the server's clock")
    body: dict[str, Any] = Field(description="fields of this kind of event")
