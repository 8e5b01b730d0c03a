"""Features of the last layer: a constant, the inputs, hidden units of a network, and fixed random waves.

At inputs x (m, d) the features of one output are

    phi(x) = [1, x, tanh(tanh(x W_1 + c_1) W_2 + c_2) / sqrt(h), sqrt(2 / r) cos(x Omega / l + beta)],

with x^2 after x if the features are quadratic. The waves are random Fourier features of a squared exponential kernel
with length scales l. They don't vanish far from the samples, so neither does the uncertainty of their weights.

Shapes: p outputs, m points, d inputs, h hidden units, r waves, k features. Every output has its own network.

Reference: A. Rahimi, B. Recht, "Random features for large-scale kernel machines", NIPS 2007.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

Hidden = tuple[Tensor, ...]  # W_1 (p, d, h), c_1 (p, 1, h), W_2 (p, h, h), c_2 (p, 1, h)


@dataclass(frozen=True)
class Features:
    """Features of p outputs."""

    first: Tensor  # W_1 (p, d, h)
    first_bias: Tensor  # c_1 (p, 1, h)
    second: Tensor  # W_2 (p, h, h)
    second_bias: Tensor  # c_2 (p, 1, h)
    frequencies: Tensor  # Omega / l (p, d, r)
    phases: Tensor  # beta (p, 1, r)

    @property
    def hidden(self) -> Hidden:
        return (self.first, self.first_bias, self.second, self.second_bias)

    @property
    def units(self) -> int:
        """h."""
        return self.second.shape[-1]

    @property
    def waves(self) -> int:
        """r."""
        return self.frequencies.shape[-1]

    def __call__(self, x: Tensor, *, quadratic: bool) -> Tensor:
        """phi(x) of x (m, d), (p, m, k)."""
        parts = [polynomial(x, quadratic).expand(len(self.first), -1, -1), hidden_units(x, self.hidden)]
        return torch.cat([*parts, random_waves(x, self.frequencies, self.phases)], -1)


def polynomial(x: Tensor, quadratic: bool) -> Tensor:
    """[1, x] or [1, x, x^2] of x (m, d), (m, s)."""
    return torch.cat([torch.ones_like(x[:, :1]), x, *([x.square()] if quadratic else [])], -1)


def hidden_units(x: Tensor, hidden: Hidden) -> Tensor:
    """Hidden units of the second layer at x (m, d), (p, m, h)."""
    first, first_bias, second, second_bias = hidden
    z = torch.tanh(torch.baddbmm(first_bias, x.expand(len(first), -1, -1), first))
    return torch.tanh(torch.baddbmm(second_bias, z, second)) / math.sqrt(second.shape[-1])


def random_waves(x: Tensor, frequencies: Tensor, phases: Tensor) -> Tensor:
    """Random Fourier features at x (m, d), (p, m, r)."""
    count = max(1, frequencies.shape[-1])
    angles = torch.baddbmm(phases, x.expand(len(frequencies), -1, -1), frequencies)
    return math.sqrt(2 / count) * angles.cos()
