"""K networks (members) with the same numbers of units, evaluated together: d inputs, h units in a layer, p outputs.

A member is f(x) = b(x) S + tanh(tanh(x W_1 + c_1) W_2 + c_2) W_3 with b(x) = [1, x], or [1, x, x^2] if its linear part
also reads squares. The linear part b(x) S needs no hidden units, and extrapolates. b(x) has s terms.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import softplus

LEAST_NOISE, MOST_NOISE = 0.003, 10.0  # bounds of the predicted noise, as shares of an output's standard deviation


@dataclass(frozen=True)
class Networks:
    """Weights of K networks, the members."""

    skip: Tensor  # (K, s, p) weights S of the linear part, for K networks with s linear terms and p outputs
    first: Tensor  # (K, d, h) weights W_1 of the first hidden layer, for K networks with d inputs and h hidden units
    first_bias: Tensor  # (K, 1, h) biases c_1 of the first hidden layer, for K networks with h units in a layer
    second: Tensor  # (K, h, h) weights W_2 of the second hidden layer, for K networks with h units in a layer
    second_bias: Tensor  # (K, 1, h) biases c_2 of the second hidden layer, for K networks with h units in a layer
    last: Tensor  # (K, h, p) weights W_3 of the last layer, for K networks with h units in a layer and p outputs

    @property
    def members(self) -> int:
        return len(self.skip)

    @property
    def hidden(self) -> tuple[Tensor, ...]:
        """Weights of the nonlinear part: all except ``skip``, the weights of the linear part."""
        return (self.first, self.first_bias, self.second, self.second_bias, self.last)

    def __call__(self, x: Tensor) -> Tensor:
        """Return the outputs (K, m, p) of each of the K networks (members) at inputs x (m, d)."""
        quadratic = self.skip.shape[1] > x.shape[-1] + 1
        return basis(x, quadratic) @ self.skip + nonlinear(x, self.hidden)


def bounded(log_variance: Tensor) -> Tensor:
    """Return log variances of noise, of any shape, softly limited so that standard deviations are between
    ``LEAST_NOISE`` and ``MOST_NOISE``."""
    low, high = 2 * math.log(LEAST_NOISE), 2 * math.log(MOST_NOISE)
    return low + softplus(high - softplus(high - log_variance) - low)


def basis(x: Tensor, quadratic: bool) -> Tensor:
    """Return the s terms (m, s) of the linear part for inputs x (m, d): [1, x], or [1, x, x^2] if ``quadratic``."""
    return torch.cat([torch.ones_like(x[:, :1]), x, *([x.square()] if quadratic else [])], -1)


def nonlinear(x: Tensor, hidden: tuple[Tensor, ...]) -> Tensor:
    """Return the outputs (K, m, p) of the nonlinear part of each of the K networks at inputs x (m, d)."""
    first, first_bias, second, second_bias, last = hidden
    z = torch.tanh(torch.baddbmm(first_bias, x.expand(len(first), -1, -1), first))
    z = torch.tanh(torch.baddbmm(second_bias, z, second))
    return z @ last
