"""Rewards learned by the logarithm of their distance from a base: r = base + sign exp(y).

A reward that pays in one place alone is flat nearly everywhere, and a process of its values learns that it is flat.
Its logarithm is not: that of a bump is a parabola, which a few samples anywhere determine.

Predictions are medians, and deviations half the distance of the quantiles that lie one deviation of y apart from the
median: both keep their meaning where y is unsure by more than a few, and the moments of a log-normal do not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

LARGEST = 300.0  # y beyond which nothing is told apart: exp(300) is a number still
PEAK_NOISE = 1e-10  # of the variance of y, at least: it is hundreds, and 1 % of a reward must be told


@dataclass(frozen=True)
class Warp:
    """The transformation of one output.

    Attributes:
        base: reward of nothing.
        sign: 1 where rewards lie above it, -1 below.
        size: deviation of the rewards over the samples, in their unit: what is ``scale`` of other outputs.
    """

    base: float
    sign: float
    size: float

    def value(self, y: Tensor) -> Tensor:
        """Reward of y (m,)."""
        return self.base + self.sign * y.clamp_max(LARGEST).exp()

    def deviation(self, y: Tensor, spread: Tensor) -> Tensor:
        """Deviation of the reward where y (m,) deviates by spread (m,)."""
        return 0.5 * ((y + spread).clamp_max(LARGEST).exp() - (y - spread).clamp_max(LARGEST).exp())

    def slope(self, y: Tensor, spread: Tensor) -> Tensor:
        """How far the reward moves with y, (m,), where y may lie as high as one deviation ``spread`` (m,) above."""
        return torch.exp((y + spread).clamp_max(LARGEST))

    def __str__(self) -> str:
        inner = "reward" if self.base == 0 else f"reward {-self.base:+g}"
        return f"log({inner})" if self.sign > 0 else f"log(-({inner}))"

    @property
    def finite(self) -> bool:
        """Whether it is one: what a file says may be anything."""
        return math.isfinite(self.base) and self.sign in (1.0, -1.0) and math.isfinite(self.size) and self.size > 0
