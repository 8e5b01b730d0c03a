"""Types of numbers and names in a specification. Text and booleans are not accepted as numbers, and the ends of a range
must differ in float64."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Annotated

from pydantic import Field

SHOWN = 40  # a message shows at most this many characters of a wrong value
# A specification may have numbers up to this size, and ranges down to this width, so that products of them stay finite.
LARGEST, NARROWEST = 1e12, 1e-12
# Largest absolute value of a number in a sample; with larger ones a variance overflows, and no fit is possible.
MAX_MEASURED = 1e30
RESOLUTION = 1e-9  # smallest width of a range, as a share of its larger end: below it, rounding errors dominate

Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST, allow_inf_nan=False, strict=True)]
Width = Annotated[float, Field(ge=NARROWEST, le=LARGEST, allow_inf_nan=False, strict=True)]
Finite = Annotated[float, Field(allow_inf_nan=False, strict=True)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False, strict=True)]
Count = Annotated[int, Field(ge=1, strict=True)]


def require(condition: bool, message: str) -> None:
    if not condition:
        raise ValueError(message)


def require_range(what: str, low: float, high: float) -> None:
    require(low < high, f"{what} crosses: expected low < high, got [{low}, {high}]")
    least = max(NARROWEST, RESOLUTION * max(abs(low), abs(high)))
    require(high - low >= least, f"{what} is too narrow: expected a width of {least:g} or more, got [{low}, {high}]")


def require_unique(what: str, names: Iterable[str]) -> None:
    earlier: set[str] = set()
    for name in names:
        require(name not in earlier, f"{what} {name!r} is given twice")
        earlier.add(name)


def require_known(where: str, names: Iterable[str], choices: Iterable[str]) -> None:
    choices = list(choices)
    unknown = [name for name in names if name not in choices]
    require(not unknown, f"{where} names unknown {unknown}: expected some of {choices}")


def trace_fault(
    coordinates: Sequence[Sequence[float]],
    action: Sequence[Sequence[float]],
    reward: Sequence[float],
    *,
    c: int,
    f: int,
) -> str | None:
    """Describe what is wrong with the shapes of an episode of T steps; None if nothing is: (T + 1, c) states, (T, f)
    actions and T rewards, with T at least 1."""
    steps, widths = len(reward), ({*map(len, coordinates)}, {*map(len, action)})
    if steps and (len(coordinates), len(action)) == (steps + 1, steps) and widths == ({c}, {f}):
        return None
    came = [
        f"{len(rows)} of {' and '.join(map(str, sorted(each))) or 'no'}"
        for rows, each in zip((coordinates, action), widths, strict=True)
    ]
    expected = f"expected {max(steps, 1) + 1} states of {c} and {max(steps, 1)} actions of {f} numbers"
    return f"{expected} for {max(steps, 1)} rewards, got states: {came[0]}, actions: {came[1]}, rewards: {steps}"
