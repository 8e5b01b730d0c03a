"""Parse the server's replies into the wire models."""

from __future__ import annotations

from typing import TypeVar

from pydantic import ValidationError

from surrogym_client.errors import ProtocolMismatch
from surrogym_shared import wire

R = TypeVar("R", bound=wire.Reply)


def parse(reply: type[R], content: bytes, path: str) -> R:
    """Parse a reply.

    Raises:
        ProtocolMismatch: the reply is not of this protocol.
    """
    try:
        return reply.model_validate_json(content)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "body"
        raise ProtocolMismatch(f"unexpected answer of {path}: {where}: {first['msg']}") from error
