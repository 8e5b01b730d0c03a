"""Outcomes of checks, and the comparison that a check consists of."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Outcome:
    """One check. ``failure`` says what was expected and what came; None if the check passed."""

    name: str
    failure: str | None


class Mismatch(Exception):
    """A check failed; the message says what was expected and what came."""


def expect(what: str, expected: object, came: object) -> None:
    """Compare two values.

    Raises:
        Mismatch: they differ.
    """
    if expected != came:
        raise Mismatch(f"{what}: expected {expected!r}, got {came!r}")
