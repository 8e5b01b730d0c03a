"""Routes of the service: the one place where a name becomes part of an address."""

from __future__ import annotations

import re

from surrogym_client.errors import refused_here
from surrogym_shared.codes import Code
from surrogym_shared.spec import NAME_IN_WORDS, NAME_PATTERN


def surrogate(name: str) -> str:
    """The route of a surrogate. Raises ``InvalidInput`` for a name that none can have."""
    return f"/v1/surrogates/{_segment(name, 'name of a surrogate')}"


def session(identity: str) -> str:
    """The route of a session. Raises ``InvalidInput`` for an id that none can have."""
    return f"/v1/sessions/{_segment(identity, 'id of a session')}"


def _segment(text: str, what: str) -> str:
    """A part of a path. Quoting would not do: ``..`` has no quoted form, and servers undo that of a slash."""
    if re.fullmatch(NAME_PATTERN, text):
        return text
    raise refused_here(Code.INVALID_REQUEST, f"{what}: expected {NAME_IN_WORDS}, got {text!r}")
