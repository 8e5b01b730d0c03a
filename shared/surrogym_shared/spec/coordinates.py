"""Coordinates of the state q: their kinds, sampling distributions, bounds and lags (repeated past values)."""

from __future__ import annotations

import math
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from surrogym_shared.checks import Number, Width, require, require_range
from surrogym_shared.kinds import CoordinateKind, LagKind
from surrogym_shared.patterns import VISIBLE
from surrogym_shared.spec.base import Frozen, Name, ends_of
from surrogym_shared.spec.terms import Term


class Uniform(Frozen):
    """Uniform distribution on [low, high]."""

    kind: Literal["uniform"] = "uniform"
    low: Number
    high: Number

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        require_range("uniform range", self.low, self.high)
        return self


class Normal(Frozen):
    """Normal distribution, truncated to [low, high]. An end that is None lies three standard deviations from the
    mean."""

    kind: Literal["normal"] = "normal"
    mean: Number
    std: Width
    low: Number | None = None
    high: Number | None = None

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        low, high = self.limits
        require_range("truncated range", low, high)
        z = max(low - self.mean, self.mean - high) / self.std
        require(
            z < 6,
            f"truncation [{low}, {high}] lies {z:.1f} standard deviations from the mean {self.mean}: expected less "
            "than 6",
        )
        return self

    @property
    def limits(self) -> tuple[float, float]:
        low = self.mean - 3 * self.std if self.low is None else self.low
        high = self.mean + 3 * self.std if self.high is None else self.high
        return low, high


class Fixed(Frozen):
    """A single value, which is allowed as the distribution of starts only."""

    kind: Literal["fixed"] = "fixed"
    value: Number


SamplingDistribution = Annotated[Uniform | Normal, Field(discriminator="kind")]
StartDistribution = Annotated[Uniform | Normal | Fixed, Field(discriminator="kind")]


def limits(distribution: Uniform | Normal | Fixed) -> tuple[float, float]:
    """Return the smallest and the largest value of a distribution."""
    match distribution:
        case Uniform():
            return distribution.low, distribution.high
        case Normal():
            return distribution.limits
        case Fixed():
            return distribution.value, distribution.value


class Bounds(Frozen):
    """Saturation: the environment clips the coordinate to [low, high].

    ``stops`` names another coordinate, such as the speed, that becomes 0 when this coordinate reaches a bound, as at a
    wall (MountainCar's left end).
    """

    low: Number | None = None
    high: Number | None = None
    stops: Name | None = None

    @model_validator(mode="after")
    def _some(self) -> Self:
        require(self.low is not None or self.high is not None, "bounds: expected a low or a high, got neither")
        if self.low is not None and self.high is not None:
            require_range("range of bounds", self.low, self.high)
        return self


class Lag(Frozen):
    """Past value that a coordinate repeats. Its next value is known, so no model learns it.

    What the coordinate has after a step depends on ``kind``. ``change``: how far coordinate ``of`` moved in the step,
    an angle by at most half a turn. ``value``: the value of coordinate ``of`` before the step. ``action``: entry
    ``entry`` of the step's action. ``steps``: the number of steps since the reset, up to the coordinate's upper bound.
    While it is below this bound, other lags are not known yet, and the model does not learn from the steps.
    """

    kind: LagKind
    of: Name | None = None
    entry: Annotated[int, Field(ge=0, strict=True)] | None = None

    @model_validator(mode="after")
    def _sourced(self) -> Self:
        if self.kind == "action":
            require(self.entry is not None and self.of is None, "a lag of kind 'action': expected 'entry' without 'of'")
        elif self.kind == "steps":
            require(self.entry is None and self.of is None, "a lag of kind 'steps': expected neither 'entry' nor 'of'")
        else:
            require(
                self.of is not None and self.entry is None,
                f"a lag of kind {self.kind!r}: expected 'of' without 'entry'",
            )
        return self


class Coordinate(Frozen):
    """One coordinate, that is one entry of the state q.

    Coordinates of kind ``linear`` and ``angle`` move; an angle is wrapped to [-pi, pi). A ``constant`` is drawn at the
    start of an episode and does not change in it (Reacher's target). A coordinate with a ``lag`` repeats the past.
    ``sampling`` is the distribution of the states of the design's queries.
    """

    name: Name
    kind: CoordinateKind = "linear"
    sampling: SamplingDistribution
    bounds: Bounds | None = None
    unit: Annotated[str, Field(pattern=VISIBLE)] = ""
    lag: Lag | None = None

    @property
    def term(self) -> Term:
        """The coordinate as a term."""
        return Term.linear(**{self.name: 1.0})

    @property
    def moves(self) -> bool:
        """Whether a model has to learn how the coordinate moves."""
        return self.kind != "constant" and self.lag is None

    @property
    def counted(self) -> int:
        """Number of steps that a lag of kind ``steps`` counts up to; 0 for other coordinates."""
        _, high = self.saturation
        return 0 if self.lag is None or self.lag.kind != "steps" or math.isinf(high) else math.ceil(high)

    @property
    def saturation(self) -> tuple[float, float]:
        """Lower and upper bound, at which the coordinate stays if the dynamics would move it further; an infinity where
        there is no bound."""
        return (-math.inf, math.inf) if self.bounds is None else ends_of(self.bounds.low, self.bounds.high)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        require(
            self.lag is None or self.kind == "linear",
            f"coordinate {self.name!r}: expected kind 'linear', because it is a lag",
        )
        if self.lag is not None and self.lag.kind == "steps":
            require(self.counted > 0, f"coordinate {self.name!r}: a lag of kind 'steps' needs an upper bound above 0")
        if self.kind != "linear":
            require(self.bounds is None, f"coordinate {self.name!r}: only a linear coordinate can have bounds")
        if self.bounds is not None:
            (least, most), (low, high) = self.saturation, limits(self.sampling)
            require(
                least <= low and high <= most,
                f"coordinate {self.name!r}: sampling range [{low}, {high}] leaves its bounds "
                f"[{self.bounds.low}, {self.bounds.high}]",
            )
        return self

    @property
    def settable(self) -> tuple[float, float]:
        """Range of values to which the original environment can be set: the bounds of the coordinate, or its sampling
        range where it has no bound."""
        (least, most), (low, high) = self.saturation, limits(self.sampling)
        return low if math.isinf(least) else least, high if math.isinf(most) else most
