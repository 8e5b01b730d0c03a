"""Types of numbers and names in a specification: distinct in float64, and neither text nor booleans in place of
numbers."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated

from pydantic import Field, ValidationError

LARGEST, NARROWEST = 1e12, 1e-12  # so that squares, products and float32 observations stay finite
RESOLUTION = 1e-9  # narrowest range relative to the size of its numbers; rounding errors dominate below

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
    seen: set[str] = set()
    for name in names:
        require(name not in seen, f"{what} {name!r} is given twice")
        seen.add(name)


def require_known(where: str, given: Iterable[str], known: Iterable[str]) -> None:
    known = list(known)
    unknown = [name for name in given if name not in known]
    require(not unknown, f"{where} names unknown {unknown}: expected some of {known}")


def first_fault(error: ValidationError) -> str:
    """The first thing that is wrong, with its place."""
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"])
    return f"{where}: {first['msg']}" if where else first["msg"]
