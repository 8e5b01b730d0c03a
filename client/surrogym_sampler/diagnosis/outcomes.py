"""Outcomes of checks, and the comparison of an expected value with the one that came."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Outcome:
    """The outcome of one check.

    Attributes:
        name: what has to hold.
        failure: what was expected and what came; None if the check passed or does not apply.
        left_out: why the check does not apply; None if it was made.
    """

    name: str
    failure: str | None
    left_out: str | None = None


class Mismatch(Exception):
    """A check failed; the message says what was expected and what came."""


def expect(what: str, expected: object, came: object) -> None:
    """Compare the value that came with the expected one.

    Args:
        what: the compared thing in words, for the message.
        expected: the value that the protocol requires.
        came: the value that was observed.

    Raises:
        Mismatch: they differ.
    """
    if expected != came:
        raise Mismatch(f"{what}: expected {expected!r}, got {came!r}")
