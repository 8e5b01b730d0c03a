"""K networks of one shape, evaluated together. K members, d inputs, h hidden units, p outputs.

A member is f(x) = b(x) S + tanh(tanh(x W_1 + c_1) W_2 + c_2) W_3 with b(x) = [1, x], or [1, x, x^2] of a quadratic one:
a linear part takes no hidden units, and extrapolates.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import softplus

LEAST_NOISE, MOST_NOISE = 0.003, 10.0  # bounds of the noise, as shares of an output's standard deviation


@dataclass(frozen=True)
class Networks:
    """Weights of K networks, the members."""

    skip: Tensor  # weights of the linear part, S (K, s, p)
    first: Tensor  # weights of the first hidden layer, W_1 (K, d, h)
    first_bias: Tensor  # biases of the first hidden layer, c_1 (K, 1, h)
    second: Tensor  # weights of the second hidden layer, W_2 (K, h, h)
    second_bias: Tensor  # biases of the second hidden layer, c_2 (K, 1, h)
    last: Tensor  # weights of the last layer, W_3 (K, h, p)

    @property
    def members(self) -> int:
        return len(self.skip)

    @property
    def hidden(self) -> tuple[Tensor, ...]:
        """Weights of the nonlinear part: all except ``skip``, the weights of the linear part."""
        return (self.first, self.first_bias, self.second, self.second_bias, self.last)

    def __call__(self, x: Tensor) -> Tensor:
        """Return the outputs of each of the K networks (members) at inputs x (m, d), (K, m, p)."""
        quadratic = self.skip.shape[1] > x.shape[-1] + 1
        return basis(x, quadratic) @ self.skip + nonlinear(x, self.hidden)


def bounded(log_variance: Tensor) -> Tensor:
    """Return log variances of noise, softly limited to the range from ``LEAST_NOISE`` to ``MOST_NOISE``."""
    low, high = 2 * math.log(LEAST_NOISE), 2 * math.log(MOST_NOISE)
    return low + softplus(high - softplus(high - log_variance) - low)


def basis(x: Tensor, quadratic: bool) -> Tensor:
    """Return the terms of the linear part for inputs x (m, d): [1, x], or [1, x, x^2] if ``quadratic``, (m, s)."""
    return torch.cat([torch.ones_like(x[:, :1]), x, *([x.square()] if quadratic else [])], -1)


def nonlinear(x: Tensor, hidden: tuple[Tensor, ...]) -> Tensor:
    """Return the outputs of the nonlinear part of each of the K networks at inputs x (m, d), (K, m, p)."""
    first, first_bias, second, second_bias, last = hidden
    z = torch.tanh(torch.baddbmm(first_bias, x.expand(len(first), -1, -1), first))
    z = torch.tanh(torch.baddbmm(second_bias, z, second))
    return z @ last
