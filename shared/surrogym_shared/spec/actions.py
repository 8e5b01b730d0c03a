"""Actions of an environment: continuous, discrete, or several discrete ones."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from surrogym_shared.checks import Number, Positive, require, require_range
from surrogym_shared.spec.base import MAX_DIMENSIONS, MAX_DISCRETE_ACTIONS, Frozen


class BoxAction(Frozen):
    """Continuous action, with each entry in [low, high].

    ``bins`` is the number of equally spaced values in each dimension from which a policy chooses (the paper's
    discretised control); None for a continuous policy. The model and the sampler always get the continuous value.

    ``rate`` is the largest change of each entry per second, or None for an entry that may change at once. If a larger
    change is requested, the nearest action that keeps the rate is taken. A rate needs a ``sampling_period``, and the
    last action among the coordinates: ``with_history(spec, actions=1, rate=...)`` declares both.
    """

    kind: Literal["box"] = "box"
    low: tuple[Number, ...] = Field(min_length=1, max_length=MAX_DIMENSIONS)
    high: tuple[Number, ...] = Field(min_length=1, max_length=MAX_DIMENSIONS)
    bins: tuple[Annotated[int, Field(ge=2, le=MAX_DISCRETE_ACTIONS, strict=True)], ...] | None = None
    rate: tuple[Positive | None, ...] | None = None

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        require(
            len(self.low) == len(self.high),
            f"action: expected as many entries in low as in high, got {len(self.low)} and {len(self.high)}",
        )
        for i, (low, high) in enumerate(zip(self.low, self.high, strict=True)):
            require_range(f"action {i}", low, high)
        for name, entries in (("bins", self.bins), ("rate", self.rate)):
            require(
                entries is None or len(entries) == len(self.low),
                f"action: expected {len(self.low)} entries in {name}, one for each entry of the action, got "
                f"{len(entries or ())}",
            )
        return self

    @property
    def size(self) -> int:
        return len(self.low)

    @property
    def nvec(self) -> tuple[int, ...]:
        """Number of values of each discrete entry: there is none."""
        return ()

    @property
    def policy_counts(self) -> tuple[int, ...]:
        """Number of values of each entry of a policy's action; empty if its actions are continuous."""
        return self.bins or ()

    @property
    def ranges(self) -> tuple[tuple[float, float], ...]:
        """Lowest and highest value of each entry."""
        return tuple(zip(self.low, self.high, strict=True))


class DiscreteAction(Frozen):
    """Discrete action: one of n, numbered 0 to n - 1."""

    kind: Literal["discrete"] = "discrete"
    n: int = Field(ge=2, le=MAX_DISCRETE_ACTIONS, strict=True)

    @property
    def size(self) -> int:
        return 1

    @property
    def nvec(self) -> tuple[int, ...]:
        """Number of values of each entry."""
        return (self.n,)

    @property
    def policy_counts(self) -> tuple[int, ...]:
        """Number of values of each entry of a policy's action."""
        return self.nvec

    @property
    def ranges(self) -> tuple[tuple[float, float], ...]:
        """Lowest and highest value of each entry."""
        return ((0.0, self.n - 1.0),)


class MultiDiscreteAction(Frozen):
    """Action of several discrete entries; entry i is a whole number from 0 to nvec[i] - 1."""

    kind: Literal["multi_discrete"] = "multi_discrete"
    nvec: tuple[Annotated[int, Field(ge=2, le=MAX_DISCRETE_ACTIONS, strict=True)], ...] = Field(
        min_length=1, max_length=MAX_DIMENSIONS
    )

    @property
    def size(self) -> int:
        return len(self.nvec)

    @property
    def policy_counts(self) -> tuple[int, ...]:
        """Number of values of each entry of a policy's action."""
        return self.nvec

    @property
    def ranges(self) -> tuple[tuple[float, float], ...]:
        """Lowest and highest value of each entry."""
        return tuple((0.0, n - 1.0) for n in self.nvec)


Action = Annotated[BoxAction | DiscreteAction | MultiDiscreteAction, Field(discriminator="kind")]
