"""``x-deadline-ms``: the time that a caller waits for a reply, so that no step is computed for a caller who
has gone."""

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
    "description": "Milliseconds from now. A step that would be answered later is refused before it is computed.",
    "schema": {"type": "integer", "minimum": 1, "maximum": 10**LONGEST_DIGITS - 1},
}


def seconds_left(headers: Mapping[str, str]) -> float | None:
    """Seconds that a caller waits; None if the header is missing.

    Raises:
        InvalidInput: not a whole number of milliseconds.
    """
    given = headers.get(HEADER)
    if given is None:
        return None
    if not (given.isascii() and given.isdigit() and len(given) <= LONGEST_DIGITS and int(given)):
        raise InvalidInput(f"{HEADER}: expected a whole number of milliseconds from 1, got {shown(given)}")
    return int(given) / 1e3
