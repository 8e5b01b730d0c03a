"""Outcomes of checks, and the comparison that a check consists of."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Outcome:
    """One check.

    Attributes:
        name: what has to hold.
        failure: what was expected and what came; None if the check passed, or was left out.
        left_out: why the check does not apply; None if it was made.
    """

    name: str
    failure: str | None
    left_out: str | None = None


class Mismatch(Exception):
    """A check failed; the message says what was expected and what came."""


def expect(what: str, expected: object, came: object) -> None:
    """Compare two values.

    Raises:
        Mismatch: they differ.
    """
    if expected != came:
        raise Mismatch(f"{what}: expected {expected!r}, got {came!r}")
