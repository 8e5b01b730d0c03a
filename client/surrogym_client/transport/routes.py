"""Routes of the server. Only this module turns names into parts of a URL.

Names are checked as well as quoted: ``..`` has no quoted form, and a server undoes the quoting of a slash.
"""

from __future__ import annotations

import re
from urllib.parse import quote

from surrogym_client.errors import refused_here
from surrogym_shared.codes import Code
from surrogym_shared.spec import NAME_IN_WORDS, NAME_PATTERN

POLICY_PATTERN = r"[a-z0-9][a-z0-9_-]{0,31}"
SESSION_PATTERN = r"[^/\\]*[^/\\.][^/\\]*"  # the server chooses the form of session ids


def surrogate(name: str) -> str:
    """Return the route of a surrogate. Raises ``InvalidInput`` for an invalid name."""
    return f"/v1/surrogates/{_segment(name, NAME_PATTERN, f'name of a surrogate: expected {NAME_IN_WORDS}')}"


def policy(name: str, which: str | int) -> str:
    """Return the route of a policy by its version, an alias or ``latest``. Raises ``InvalidInput`` for an invalid
    one."""
    expected = "policy: expected a version, an alias or latest"
    return f"{surrogate(name)}/policies/{_segment(str(which), POLICY_PATTERN, expected)}"


def job(name: str, id: int) -> str:
    """Return the route of a job. Raises ``InvalidInput`` for an invalid name of a surrogate."""
    return f"{surrogate(name)}/jobs/{id:d}"


def alias(name: str) -> str:
    """Return an alias as the last part of a route. Raises ``InvalidInput`` for an invalid one."""
    return _segment(name, POLICY_PATTERN, "alias of a policy: expected lower-case letters, digits, - and _")


def session(identity: str) -> str:
    """Return the route of a session. Raises ``InvalidInput`` for an invalid id."""
    expected = "id of a session: expected no slash, and at least one character other than a dot"
    return f"/v1/sessions/{_segment(identity, SESSION_PATTERN, expected)}"


def _segment(text: str, pattern: str, expected: str) -> str:
    if not re.fullmatch(pattern, text):
        raise refused_here(Code.INVALID_REQUEST, f"{expected}, got {text!r}")
    return quote(text, safe="")
