"""Types of numbers and names in a specification: distinct in float64, and neither text nor booleans in place of
numbers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Annotated

from pydantic import BaseModel, Field, ValidationError
from pydantic_core import ErrorDetails

from surrogym_shared.entries import of_unknown

LARGEST, NARROWEST = 1e12, 1e-12  # bounds of numbers, so that squares, products and float32 observations stay finite
SHOWN = 40  # characters of a wrong value in a message
RESOLUTION = 1e-9  # narrowest range relative to the size of its numbers; in a narrower one rounding errors dominate

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


def require_known(where: str, names: Iterable[str], known: Iterable[str]) -> None:
    known = list(known)
    unknown = [name for name in names if name not in known]
    require(not unknown, f"{where} names unknown {unknown}: expected some of {known}")


def trace_fault(
    coordinates: Sequence[Sequence[float]],
    action: Sequence[Sequence[float]],
    reward: Sequence[float],
    *,
    c: int,
    f: int,
) -> str | None:
    """What is wrong with the shape of an episode of T steps; None for (T + 1, c) states, (T, f) actions and T rewards,
    with T at least 1."""
    steps, widths = len(reward), ({*map(len, coordinates)}, {*map(len, action)})
    if steps and (len(coordinates), len(action)) == (steps + 1, steps) and widths == ({c}, {f}):
        return None
    came = [
        f"{len(rows)} of {' and '.join(map(str, sorted(each))) or 'no'}"
        for rows, each in zip((coordinates, action), widths, strict=True)
    ]
    expected = f"expected {max(steps, 1) + 1} states of {c} and {max(steps, 1)} actions of {f} numbers"
    return f"{expected} for {max(steps, 1)} rewards, got states: {came[0]}, actions: {came[1]}, rewards: {steps}"


def first_fault(error: ValidationError, *, got: bool = False, of: type[BaseModel] | None = None) -> str:
    """Describe the first thing that is wrong, with its place.

    Args:
        error: the error.
        got: whether to add the value that came to this place.
        of: model of the input. An unknown entry is then described by the allowed ones, and precedes a missing entry,
            because it may be that one with a wrong name.
    """
    faults = error.errors()
    unknown = next((fault for fault in faults if fault["type"] == "extra_forbidden"), None)
    first = unknown if of is not None and unknown is not None and faults[0]["type"] == "missing" else faults[0]
    where = ".".join(str(part) for part in first["loc"])
    came = f", got {repr(first['input'])[:SHOWN]}" if got and where else ""
    if of is not None and first["type"] == "extra_forbidden":
        return f"{where}: {of_unknown(of, first['loc'])}{came}"
    return f"{where}{': ' if where else ''}{_expected(first)}{came}"


def _expected(fault: ErrorDetails) -> str:
    """What a validation expected. Numbers of entries are written without words of Python."""
    context = fault.get("ctx", {})
    match fault["type"]:
        case "too_short":
            return f"expected {context['min_length']} or more entries, got {context['actual_length']}"
        case "too_long" if context["actual_length"] is not None:
            return f"expected at most {context['max_length']} entries, got {context['actual_length']}"
        case _:
            return fault["msg"].removeprefix("Value error, ")
