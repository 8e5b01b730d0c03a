"""One-dimensional distributions of coordinates, by their inverse distribution functions.

Every random value is first drawn as a uniform number, so that Latin hypercubes and counter-based noise share one path.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class UniformDefinition:
    """Uniform on [low, high]."""

    low: float
    high: float

    def quantile(self, p: Tensor) -> Tensor:
        """The value with a share p of the distribution below it."""
        return self.low + (self.high - self.low) * p

    def log_density(self, value: Tensor) -> Tensor:
        """Logarithm of the density within the limits, less its largest."""
        return torch.zeros_like(value)


@dataclass(frozen=True)
class NormalDefinition:
    """Normal, truncated to [low, high]."""

    mean: float
    std: float
    low: float
    high: float

    def quantile(self, p: Tensor) -> Tensor:
        """The value with a share p of the distribution below it."""
        edges = torch.tensor([self.low, self.high], dtype=p.dtype, device=p.device)
        below, above = torch.special.ndtr((edges - self.mean) / self.std)
        value: Tensor = self.mean + self.std * torch.special.ndtri(below + (above - below) * p)
        return torch.clamp(value, self.low, self.high)

    def log_density(self, value: Tensor) -> Tensor:
        """Logarithm of the density within the limits, less its largest, if the limits hold the mean."""
        return -0.5 * ((value - self.mean) / self.std).square()


@dataclass(frozen=True)
class FixedDefinition:
    """A single value."""

    value: float

    @property
    def low(self) -> float:
        return self.value

    @property
    def high(self) -> float:
        return self.value

    def quantile(self, p: Tensor) -> Tensor:
        """The value, for any p."""
        return torch.full_like(p, self.value)

    def log_density(self, value: Tensor) -> Tensor:
        """0, for any value."""
        return torch.zeros_like(value)


Distribution = UniformDefinition | NormalDefinition | FixedDefinition


def scaling(distribution: Distribution) -> tuple[float, float]:
    """Centre and scale that give a sampled coordinate mean 0 and standard deviation about 1."""
    match distribution:
        case UniformDefinition(low, high):
            return (low + high) / 2, (high - low) / math.sqrt(12)
        case NormalDefinition(mean, std):
            return mean, std
        case FixedDefinition(value):
            return value, 1.0
