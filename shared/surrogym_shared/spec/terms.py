"""Terms (functions of the state q), and observation entries, inequalities and terminations made of them."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Discriminator, Field, Tag, model_validator

from surrogym_shared.checks import Finite, Number, require
from surrogym_shared.kinds import Function, Relation
from surrogym_shared.spec.base import MAX_INEQUALITIES, MAX_TERM_PARTS, Frozen, Name


class Part(Frozen):
    """Summand of a term of the state q: coefficient * phi(q). phi is 1 for the function ``one``, a.q for ``linear``,
    sin(a.q) for ``sin``, and cos(a.q) for ``cos``, where a are the ``weights``."""

    function: Function
    coefficient: Number = 1.0
    weights: dict[Name, Number] = Field(
        default_factory=dict, description="weight of each coordinate in a.q, by the coordinate's name"
    )

    @model_validator(mode="after")
    def _weighted(self) -> Self:
        if self.function == "one":
            require(not self.weights, "a part with function 'one' takes no weights")
        else:
            require(bool(self.weights), f"a part with function {self.function!r} needs weights")
        return self


class Term(Frozen):
    """Function of the state: a sum of parts, clipped to [low, high] if these are given. Terms can be added with ``+``
    and scaled with ``*``."""

    parts: tuple[Part, ...] = Field(min_length=1, max_length=MAX_TERM_PARTS)
    low: Number | None = None
    high: Number | None = None

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.low is not None and self.high is not None:
            require(
                self.low < self.high, f"limits of a clipped term: expected low < high, got [{self.low}, {self.high}]"
            )
        return self

    @classmethod
    def constant(cls, value: float) -> Term:
        return cls(parts=(Part(function="one", coefficient=value),))

    @classmethod
    def linear(cls, /, **weights: float) -> Term:
        """Make a weighted sum of coordinates: ``Term.linear(x=1)`` is the coordinate x."""
        return cls(parts=(Part(function="linear", weights=weights),))

    @classmethod
    def sin(cls, /, **weights: float) -> Term:
        return cls(parts=(Part(function="sin", weights=weights),))

    @classmethod
    def cos(cls, /, **weights: float) -> Term:
        return cls(parts=(Part(function="cos", weights=weights),))

    def clipped(self, low: float | None, high: float | None) -> Term:
        return self.model_copy(update={"low": low, "high": high})

    def __add__(self, other: Term) -> Term:
        require(
            self.low is None and self.high is None and other.low is None and other.high is None,
            "clipped terms can't be added: add the terms first, then clip the sum",
        )
        return Term(parts=self.parts + other.parts)

    def __mul__(self, factor: float) -> Term:
        require(self.low is None and self.high is None, "a clipped term can't be scaled: scale it before clipping")
        parts = (p.model_copy(update={"coefficient": p.coefficient * factor}) for p in self.parts)
        return Term(parts=tuple(parts))

    __rmul__ = __mul__


class ObservationEntry(Frozen):
    """One entry of the observation: its name, the term of the state that computes it, and its ends in the
    observation space."""

    name: Name
    term: Term
    low: Finite | None = None
    high: Finite | None = None


class Inequality(Frozen):
    """Condition ``term relation value``, for instance height > 1."""

    term: Term
    relation: Relation
    value: Number


AllOf = Annotated[tuple[Inequality, ...], Field(min_length=1, max_length=MAX_INEQUALITIES)]


def _termination_kind(value: object) -> str:
    return "learned" if isinstance(value, str) else "declared"


Termination = Annotated[
    Annotated[tuple[AllOf, ...], Field(max_length=MAX_INEQUALITIES), Tag("declared")]
    | Annotated[Literal["learned"], Tag("learned")],
    Discriminator(_termination_kind),
    Field(
        description="groups of inequalities: an episode terminates if, after a step, all of any group hold; or "
        "'learned': the model learns from samples when an episode terminates"
    ),
]
