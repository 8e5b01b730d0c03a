"""Reward of a specification, learned or declared, and the criteria for a successful episode."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Discriminator, Field, Tag, model_validator

from surrogym_shared.checks import Count, Number, require
from surrogym_shared.kinds import RewardShape, RewardTiming
from surrogym_shared.spec.base import MAX_DIMENSIONS, MAX_INEQUALITIES, MAX_TERM_PARTS, Frozen
from surrogym_shared.spec.terms import Inequality, Term


class Reward(Frozen):
    """Settings of a learned reward, which is the usual case.

    ``timing``: the state that the reward depends on. ``before`` is (q, u), as in Gymnasium's Pendulum; ``after`` is
    (q', u), as in the paper; ``auto`` chooses at each fit the timing that the data favour.

    ``penalty``: k of eq. 14, where a virtual reward is mean - k * standard deviation. None takes the value of the
    preset (0 for ``default``, 3 for ``paper``).
    """

    kind: Literal["learned"] = "learned"
    timing: RewardTiming = "before"
    penalty: Annotated[float, Field(ge=0, le=100, strict=True)] | None = None


class Quantity(Frozen):
    """Quantity x of a declared reward, as a function of state q and action u: x = term(q) + action . u, where
    ``action`` has a weight for each entry of u."""

    term: Term | None = None
    action: tuple[Number, ...] = Field(default=(), max_length=MAX_DIMENSIONS)

    @model_validator(mode="after")
    def _something(self) -> Self:
        require(
            self.term is not None or bool(self.action),
            "a quantity: expected a term or weights of the action, got neither",
        )
        return self

    @property
    def of_state(self) -> Term:
        """The term; the constant 0 for a quantity that depends on the action alone."""
        return Term.constant(0.0) if self.term is None else self.term


class RewardTerm(Frozen):
    """Term of a declared reward: weight * shape(of) if every inequality in ``when`` holds, else 0.

    With x the quantities in ``of``, the shapes are ``one``: 1; ``linear``: sum of x; ``absolute``: sum of |x|;
    ``square``: sum of x^2; ``bump``: exp(-1/2 sum of x^2); ``ball``: 1 where the sum of x^2 is at most 1, else 0.
    """

    weight: Number = 1.0
    shape: RewardShape
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
    """A known reward, the sum of its terms, so that it is not learned. It is data, never evaluated as code.

    ``timing`` says whether the terms depend on the state before or after the step. ``terminal`` is added to the reward
    of a step that ends the episode in a terminal state.
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
    """Criteria of a successful evaluation episode. All criteria that are given must hold.

    ``hold``: inequalities that must all hold in each of the last ``hold_steps`` steps. ``min_steps``: the episode must
    have at least this many steps. ``terminated``: whether the episode must end in a terminal state. ``min_return``: the
    return must be at least this.
    """

    hold: tuple[Inequality, ...] = Field(default=(), max_length=MAX_INEQUALITIES)
    hold_steps: Count = 1
    min_steps: Count | None = None
    terminated: bool | None = None
    min_return: Number | None = None
