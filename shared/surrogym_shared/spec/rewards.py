"""What steps and episodes are worth: a reward that is learned or declared, and when an episode is a success."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Discriminator, Field, Tag, model_validator

from surrogym_shared.checks import Count, Number, require
from surrogym_shared.spec.base import MAX_DIMENSIONS, MAX_INEQUALITIES, MAX_TERM_PARTS, Frozen
from surrogym_shared.spec.terms import Inequality, Term


class Reward(Frozen):
    """How the reward is learned, which is the rule.

    ``timing``: ``before`` reads (q, u), as Gymnasium's Pendulum does; ``after`` reads (q', u), as the paper says;
    ``auto`` takes, at each fit, the one that the evidence favours.
    ``penalty``: k of eq. 14, reward = mean - k * deviation; None takes the preset's (default 0, paper 3).
    """

    kind: Literal["learned"] = "learned"
    timing: Literal["before", "after", "auto"] = "before"
    penalty: Annotated[float, Field(ge=0, le=100, strict=True)] | None = None


class Quantity(Frozen):
    """What a declared reward measures: x = term(q) + action . u, ``action`` a weight for each entry of u."""

    term: Term | None = None
    action: tuple[Number, ...] = Field(default=(), max_length=MAX_DIMENSIONS)

    @model_validator(mode="after")
    def _something(self) -> Self:
        require(self.term is not None or bool(self.action), "a quantity needs a term or weights of the action")
        return self


class RewardTerm(Frozen):
    """weight * shape(of), where every inequality in ``when`` holds, else 0.

    ``one``: 1. ``linear``: sum of x. ``absolute``: sum of |x|. ``square``: sum of x^2. ``bump``: exp(-1/2 sum of x^2).
    """

    weight: Number = 1.0
    shape: Literal["one", "linear", "absolute", "square", "bump"]
    of: tuple[Quantity, ...] = Field(default=(), max_length=MAX_TERM_PARTS)
    when: tuple[Inequality, ...] = Field(default=(), max_length=MAX_INEQUALITIES)

    @model_validator(mode="after")
    def _measured(self) -> Self:
        if self.shape == "one":
            require(not self.of, "a reward term of shape 'one' takes no quantities")
        else:
            require(bool(self.of), f"a reward term of shape {self.shape!r} needs quantities to measure")
        return self


class DeclaredReward(Frozen):
    """A reward that is known: the sum of its terms, so no query is spent on it. Data, never evaluated as code.

    ``timing`` says which state the terms read; ``terminal`` is what a step that ends the episode pays beyond them.
    """

    kind: Literal["declared"]
    terms: tuple[RewardTerm, ...] = Field(min_length=1, max_length=MAX_TERM_PARTS)
    timing: Literal["before", "after"] = "before"
    terminal: Number = 0.0


def _reward_kind(value: object) -> object:
    return value.get("kind", "learned") if isinstance(value, dict) else getattr(value, "kind", "learned")


AnyReward = Annotated[
    Annotated[Reward, Tag("learned")] | Annotated[DeclaredReward, Tag("declared")], Discriminator(_reward_kind)
]


class Success(Frozen):
    """When an evaluation episode counts as a success. Every criterion given must hold.

    ``hold``: all inequalities hold through the last ``hold_steps`` steps; ``min_steps``: at least so many steps;
    ``max_steps``: at most; ``terminated``: the episode ended (or did not end) by termination; ``min_return``.
    """

    hold: tuple[Inequality, ...] = Field(default=(), max_length=MAX_INEQUALITIES)
    hold_steps: Count = 1
    min_steps: Count | None = None
    terminated: bool | None = None
    min_return: Number | None = None
