"""Limits that a machine must keep at every step, and the fallback that brings it back."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Discriminator, Field, Tag, model_validator

from surrogym_shared.checks import Number, require
from surrogym_shared.patterns import NAME, VISIBLE
from surrogym_shared.spec.base import MAX_DIMENSIONS, MAX_INEQUALITIES, Frozen, Name
from surrogym_shared.spec.terms import Term


class Limit(Frozen):
    """Range of a term of the state that must never be left, such as the angle of an arm between its stops.

    ``margin``: distance from ``low`` and ``high``, in the term's unit, within which the fallback acts. It has to be
    larger than the largest amount by which the term's change in a step can exceed its change in the previous step.

    ``unit``: unit of ``low``, ``high`` and ``margin``. If the term is a single coordinate, it is the coordinate's unit.
    """

    name: Name
    term: Term
    low: Number | None = None
    high: Number | None = None
    margin: Annotated[Number, Field(ge=0)] = 0.0
    unit: str = Field(default="", max_length=64, pattern=VISIBLE)

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        low, high = self.low, self.high
        require(low is not None or high is not None, f"limit {self.name!r}: expected low, high or both, got neither")
        if low is not None and high is not None:
            require(
                low + self.margin < high - self.margin,
                f"limit {self.name!r}: expected room between low and high less the margin on each side, got "
                f"[{low}, {high}] and a margin of {self.margin}",
            )
        return self


class NamedFallback(Frozen):
    """Fallback that is a program at the machine. The command line of the sampler gives the program for the name."""

    name: str = Field(pattern=NAME)


def _fallback_kind(value: object) -> str:
    return "program" if isinstance(value, dict | NamedFallback) else "terms"


Fallback = Annotated[
    Annotated[tuple[Term, ...], Field(min_length=1, max_length=MAX_DIMENSIONS), Tag("terms")]
    | Annotated[NamedFallback, Tag("program")],
    Discriminator(_fallback_kind),
]


class Limits(Frozen):
    """Limits that sampler, audits and evaluations keep, and the fallback near them.

    ``fallback``: for each entry of the action, a term of the state that gives its value near a limit, such as a
    constant or a linear feedback; or the name of a program at the machine. Values are clipped to the action's range.

    ``probability``: largest share of episodes that may leave a limit.
    """

    keep: tuple[Limit, ...] = Field(min_length=1, max_length=MAX_INEQUALITIES)
    fallback: Fallback
    probability: Annotated[float, Field(gt=0, le=0.5, strict=True)] = 0.01
