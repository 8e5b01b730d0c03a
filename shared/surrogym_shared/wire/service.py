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
    protocol: int = Field(
        default=PROTOCOL, description="version of the HTTP protocol, which must be equal in the client"
    )


class Ready(Reply):
    """Reply that says whether the server can store data."""

    status: Literal["ready", "not_ready"] = Field(
        description="``ready``: all tables of the database exist, and a test write succeeded"
    )
    storage: str = Field(description="``ok`` if the storage works")


class Access(Reply):
    """Role of the caller's token."""

    role: Role = Field(description="role of the caller's token")
    tokens: bool = Field(description="whether the server has tokens; if it has none, every caller has the role admin")


class Event(Reply):
    """Server-sent event of a surrogate. Its ``id`` increases, so that a reader can continue with Last-Event-ID."""

    id: int = Field(description="id of the event, which is higher than those of earlier events")
    kind: EventKind = Field(description="kind of the event")
    created_at: float = Field(description="when the event happened, in seconds since 1970, by the server's clock")
    body: dict[str, Any] = Field(description="further fields, which depend on the kind of the event")
