"""Rewards r that are learned by the logarithm y of their distance from a base: r = base + sign exp(y).

A reward that differs from the base in one place only is flat almost everywhere, so a Gaussian process of such rewards
learns that they are flat. The logarithm is not flat: that of a Gaussian bump is a parabola, determined by few samples.

Predictions are medians. A standard deviation is half the distance between the two quantiles that lie one standard
deviation of y away from the median. Median and quantiles stay meaningful if y is uncertain by several units; the
moments of a log-normal distribution do not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

LARGEST = 300.0  # a larger logarithm y is replaced by this before its exponential is computed, to avoid overflow
# Least noise variance of a fit to the logarithms y, as a share of the variance of y. It is small because y may span
# hundreds of units, but rewards need a resolution of 1 %.
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
        """Return the rewards (m,) that belong to the logarithms y (m,)."""
        return self.base + self.sign * y.clamp_max(LARGEST).exp()

    def std(self, y: Tensor, spread: Tensor) -> Tensor:
        """Return the standard deviation (m,) of the reward, if its logarithm has the mean y (m,) and the standard
        deviation ``spread`` (m,)."""
        return 0.5 * ((y + spread).clamp_max(LARGEST).exp() - (y - spread).clamp_max(LARGEST).exp())

    def slope(self, y: Tensor, spread: Tensor) -> Tensor:
        """Return the absolute derivative of the reward with respect to its logarithm, (m,), at the logarithm y +
        ``spread``: the mean y (m,) plus one standard deviation ``spread`` (m,)."""
        return torch.exp((y + spread).clamp_max(LARGEST))

    def __str__(self) -> str:
        inner = "reward" if self.base == 0 else f"reward {-self.base:+g}"
        return f"log({inner})" if self.sign > 0 else f"log(-({inner}))"

    @property
    def finite(self) -> bool:
        """Whether base, sign and size are finite and valid. They may come from a file, so this has to be checked."""
        return math.isfinite(self.base) and self.sign in (1.0, -1.0) and math.isfinite(self.size) and self.size > 0
