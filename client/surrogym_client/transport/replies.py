"""Parse the server's replies into the wire models, and make keys by which the server recognises a repeated request."""

from __future__ import annotations

from typing import TypeVar
from uuid import uuid4

from pydantic import ValidationError

from surrogym_client.errors import ProtocolMismatch
from surrogym_shared import wire

R = TypeVar("R", bound=wire.Reply)


def parse(reply: type[R], content: bytes, path: str) -> R:
    """Parse the content of a server's reply from ``path`` into its wire model.

    Raises:
        ProtocolMismatch: the content does not fit the model.
    """
    try:
        return reply.model_validate_json(content)
    except ValidationError as error:
        from surrogym_shared.faults import first_fault  # imported here, because only an error needs it

        raise ProtocolMismatch(
            f"the server's answer to {path} can't be read: {first_fault(error)}; upgrade the older of client and server"
        ) from error


def new_key() -> str:
    """Return a new idempotency key, by which the server recognises a repeated request."""
    return uuid4().hex


def check_protocol(protocol: int, url: str) -> None:
    """Raise ``ProtocolMismatch`` if the server at ``url`` has another version of the protocol."""
    if protocol != wire.PROTOCOL:
        raise ProtocolMismatch(f"expected protocol {wire.PROTOCOL} at {url}, got {protocol}: upgrade the older side")
