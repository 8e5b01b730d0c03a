"""One-dimensional distributions of coordinates, represented by their inverse distribution functions.

Every random value is computed from a uniform number, whether this number comes from a Latin hypercube or from the
random generator of an episode.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import lru_cache

import torch
from torch import Tensor

from surrogym_shared.spec import Fixed, Normal, Uniform

Distribution = Uniform | Normal | Fixed


def quantiles(distributions: Iterable[Distribution], p: Tensor) -> Tensor:
    """Return the ``quantile`` of each of C distributions for its column of p (n, C), (n, C)."""
    return torch.stack([quantile(one, column) for one, column in zip(distributions, p.unbind(-1), strict=True)], -1)


def quantile(distribution: Distribution, p: Tensor) -> Tensor:
    """Return the value below which a share p of the distribution lies, for each entry of p, of any shape."""
    match distribution:
        case Uniform(low=low, high=high):
            return low + (high - low) * p
        case Normal(mean=mean, std=std):
            low, high = distribution.limits
            below, above = _shares_below((low, high), mean, std)
            value: Tensor = mean + std * torch.special.ndtri(below + (above - below) * p)
            return torch.clamp(value, low, high)
        case Fixed(value=constant):
            return torch.full_like(p, constant)


@lru_cache(maxsize=1_024)
def _shares_below(ends: tuple[float, float], mean: float, std: float) -> list[float]:
    """Return the shares of a normal distribution, not limited, that lie below each of two ends."""
    shares: list[float] = torch.special.ndtr((torch.tensor(ends, dtype=torch.float64) - mean) / std).tolist()
    return shares


def log_density(distribution: Distribution, value: Tensor) -> Tensor:
    """Return the log density at each entry of ``value``, of any shape and within the limits, less the largest log
    density. For a normal distribution the largest is that at the mean; for others the result is 0."""
    if isinstance(distribution, Normal):
        return -0.5 * ((value - distribution.mean) / distribution.std).square()
    return torch.zeros_like(value)


def scaling(distribution: Distribution) -> tuple[float, float]:
    """Return a centre and a scale such that (value - centre) / scale has mean 0 and standard deviation about 1 for
    sampled values."""
    match distribution:
        case Uniform(low=low, high=high):
            return (low + high) / 2, (high - low) / math.sqrt(12)
        case Normal(mean=mean, std=std):
            return mean, std
        case Fixed(value=value):
            return value, 1.0
