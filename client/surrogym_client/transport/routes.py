"""Routes of the server and their replies. Only this module turns names into parts of a URL.

Names are checked as well as quoted: ``..`` has no quoted form, and a server undoes the quoting of a slash. Replies
become wire models. A repeated request has a key by which the server recognises it.
"""

from __future__ import annotations

import re
from typing import TypeVar
from urllib.parse import quote
from uuid import uuid4

from pydantic import ValidationError

from surrogym_client.errors import ProtocolMismatch, refused_here
from surrogym_shared import wire
from surrogym_shared.codes import Code
from surrogym_shared.patterns import ALIAS, IN_WORDS, NAME, POLICY

SESSION_PATTERN = r"[^/\\]*[^/\\.][^/\\]*"  # any single part of a URL; the server chooses the ids


def surrogate(name: str) -> str:
    """Return the route of a surrogate. Raises ``InvalidInput`` for an invalid name."""
    return f"/v1/surrogates/{_segment(name, NAME, f'name of a surrogate: expected {IN_WORDS[NAME]}')}"


def policy(name: str, which: str | int) -> str:
    """Return the route of a policy. ``which`` is its version, an alias or ``latest``; ``InvalidInput`` is raised for
    any other text."""
    return f"{surrogate(name)}/policies/{_segment(str(which), POLICY, f'policy: expected {IN_WORDS[POLICY]}')}"


def job(name: str, id: int) -> str:
    """Return the route of a job. Raises ``InvalidInput`` for an invalid name of a surrogate."""
    return f"{surrogate(name)}/jobs/{id:d}"


def alias(name: str) -> str:
    """Return an alias as the last part of a route. Raises ``InvalidInput`` for an invalid alias."""
    return _segment(name, ALIAS, f"alias of a policy: expected {IN_WORDS[ALIAS]}")


def session(identity: str) -> str:
    """Return the route of a session. Raises ``InvalidInput`` for an invalid id."""
    expected = "id of a session: expected no slash, and at least one character other than a dot"
    return f"/v1/sessions/{_segment(identity, SESSION_PATTERN, expected)}"


def _segment(text: str, pattern: str, expected: str) -> str:
    if not re.fullmatch(pattern, text):
        raise refused_here(Code.INVALID_REQUEST, f"{expected}, got {text!r}")
    return quote(text, safe="")


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
