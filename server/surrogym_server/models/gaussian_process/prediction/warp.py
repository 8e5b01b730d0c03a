"""Rewards learned by the logarithm of their distance from a base: r = base + sign exp(y).

A reward that differs from its base in one place only is flat almost everywhere, so a Gaussian process of its values
learns that it is flat. Its logarithm is not flat: the logarithm of a bump is a parabola, which a few samples determine.

Predictions are medians. A standard deviation is half the distance between the two quantiles that lie one standard
deviation of y away from the median. Both stay meaningful if y is uncertain by several units; the moments of a
log-normal distribution do not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

LARGEST = 300.0  # greatest logarithm y whose exponential is computed; a larger one is replaced by it to avoid overflow
# Least noise variance, as a share of that of y; y may span hundreds of units, but rewards need a resolution of 1 %.
PEAK_NOISE = 1e-10


@dataclass(frozen=True)
class Warp:
    """Transformation between rewards r and the logarithms y by which they are learned: r = base + sign exp(y).

    Attributes:
        base: reward far from the peak.
        sign: 1 if rewards lie above the base, -1 if below.
        size: standard deviation of the rewards over the samples, in their unit.
    """

    base: float
    sign: float
    size: float

    def value(self, y: Tensor) -> Tensor:
        """Return the rewards with logarithms y (m,), (m,)."""
        return self.base + self.sign * y.clamp_max(LARGEST).exp()

    def std(self, y: Tensor, spread: Tensor) -> Tensor:
        """Return the standard deviation of the reward if y (m,) has the standard deviation ``spread`` (m,)."""
        return 0.5 * ((y + spread).clamp_max(LARGEST).exp() - (y - spread).clamp_max(LARGEST).exp())

    def slope(self, y: Tensor, spread: Tensor) -> Tensor:
        """Return the absolute derivative of the reward with respect to y, (m,), evaluated one standard deviation
        ``spread`` (m,) above y."""
        return torch.exp((y + spread).clamp_max(LARGEST))

    def __str__(self) -> str:
        inner = "reward" if self.base == 0 else f"reward {-self.base:+g}"
        return f"log({inner})" if self.sign > 0 else f"log(-({inner}))"

    @property
    def finite(self) -> bool:
        """Whether all numbers are finite and valid. This has to be checked because they may come from a file."""
        return math.isfinite(self.base) and self.sign in (1.0, -1.0) and math.isfinite(self.size) and self.size > 0
