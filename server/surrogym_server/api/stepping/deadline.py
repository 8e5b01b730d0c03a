"""The header ``x-deadline-ms``: how long a caller waits for a reply. If the reply would come later, the step is not
computed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from surrogym_server.api.problems import shown
from surrogym_server.errors import InvalidInput

HEADER = "x-deadline-ms"
LONGEST_DIGITS = 9

PARAMETER: dict[str, Any] = {
    "name": HEADER,
    "in": "header",
    "required": False,
    "description": "How many milliseconds the caller waits for the reply. If it would come later, the step is refused.",
    "schema": {"type": "integer", "minimum": 1, "maximum": 10**LONGEST_DIGITS - 1},
}


def seconds_left(headers: Mapping[str, str]) -> float | None:
    """Return how long the caller of a request waits, in seconds; None if the header is missing.

    Raises:
        InvalidInput: the header is not a whole number of milliseconds.
    """
    given = headers.get(HEADER)
    if given is None:
        return None
    if not (given.isascii() and given.isdigit() and len(given) <= LONGEST_DIGITS and int(given)):
        raise InvalidInput(f"{HEADER}: expected a whole number of milliseconds, at least 1, got {shown(given)}")
    return int(given) / 1e3
