"""One-dimensional distributions of coordinates, represented by their inverse distribution functions.

Every random value is computed from a uniform number, whether this number comes from a Latin hypercube or from the
random generator of an episode.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class UniformDefinition:
    """Uniform distribution on [low, high]."""

    low: float
    high: float

    def quantile(self, p: Tensor) -> Tensor:
        """Return the value below which a share p of the distribution lies, for each entry of p, of any shape."""
        return self.low + (self.high - self.low) * p

    def log_density(self, value: Tensor) -> Tensor:
        """Return 0 for each value: the log density within the limits, less its maximum."""
        return torch.zeros_like(value)


@dataclass(frozen=True)
class NormalDefinition:
    """Normal distribution, truncated to [low, high]."""

    mean: float
    std: float
    low: float
    high: float

    def quantile(self, p: Tensor) -> Tensor:
        """Return the value below which a share p of the distribution lies, for each entry of p, of any shape."""
        edges = torch.tensor([self.low, self.high], dtype=p.dtype, device=p.device)
        below, above = torch.special.ndtr((edges - self.mean) / self.std)
        value: Tensor = self.mean + self.std * torch.special.ndtri(below + (above - below) * p)
        return torch.clamp(value, self.low, self.high)

    def log_density(self, value: Tensor) -> Tensor:
        """Return the log density at each entry of ``value``, of any shape and within the limits, less the log density
        at the mean."""
        return -0.5 * ((value - self.mean) / self.std).square()


@dataclass(frozen=True)
class FixedDefinition:
    """Distribution of a constant."""

    value: float

    @property
    def low(self) -> float:
        return self.value

    @property
    def high(self) -> float:
        return self.value

    def quantile(self, p: Tensor) -> Tensor:
        """Return the constant, for any p."""
        return torch.full_like(p, self.value)

    def log_density(self, value: Tensor) -> Tensor:
        """Return 0, for any value."""
        return torch.zeros_like(value)


Distribution = UniformDefinition | NormalDefinition | FixedDefinition


def scaling(distribution: Distribution) -> tuple[float, float]:
    """Return a centre and a scale such that (value - centre) / scale has mean 0 and standard deviation about 1 for
    sampled values."""
    match distribution:
        case UniformDefinition(low, high):
            return (low + high) / 2, (high - low) / math.sqrt(12)
        case NormalDefinition(mean, std):
            return mean, std
        case FixedDefinition(value):
            return value, 1.0
