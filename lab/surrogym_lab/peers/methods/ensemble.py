"""Ensembles of probabilistic networks, each of which predicts a mean and a variance (torch, single precision).

K. Chua et al., "Deep Reinforcement Learning in a Handful of Trials using Probabilistic Dynamics Models", NeurIPS 2018.

Shapes: B networks, n samples, I inputs, E outputs.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import torch
from torch import Tensor, nn

LIMIT_WEIGHT = 0.01  # of the limits of log variances in the loss


class Ensemble(nn.Module):
    """B networks with swish units. Inputs are scaled by the samples' mean and deviation.

    Args:
        inputs, outputs: numbers of each.
        networks: B.
        hidden: widths of the layers.
        decay: weight decay of each layer, one more than ``hidden``.
    """

    def __init__(
        self, inputs: int, outputs: int, networks: int, hidden: tuple[int, ...], decay: tuple[float, ...]
    ) -> None:
        super().__init__()
        widths = [inputs, *hidden, 2 * outputs]
        self._decay = decay
        self.weights = nn.ParameterList(
            nn.init.trunc_normal_(torch.empty(networks, a, b), std=1 / (2 * a**0.5)) for a, b in pairwise(widths)
        )
        self.biases = nn.ParameterList(torch.zeros(networks, 1, b) for b in widths[1:])
        self.highest = nn.Parameter(torch.full((outputs,), 0.5))  # log variance
        self.lowest = nn.Parameter(torch.full((outputs,), -10.0))
        self.register_buffer("middle", torch.zeros(inputs))
        self.register_buffer("spread", torch.ones(inputs))

    def scale_by(self, x: Tensor) -> None:
        """Take mean and deviation of inputs (n, I)."""
        self.middle: Tensor
        self.spread: Tensor
        self.middle, self.spread = moments(x)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Means and log variances (B, n, E) of each network at its own inputs (B, n, I)."""
        x = (x - self.middle) / self.spread
        for place, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            x = torch.baddbmm(bias, x, weight)
            if place + 1 < len(self.weights):
                x = nn.functional.silu(x)
        mean, log_variance = x.chunk(2, -1)
        log_variance = self.highest - nn.functional.softplus(self.highest - log_variance)
        return mean, self.lowest + nn.functional.softplus(log_variance - self.lowest)

    def loss(self, x: Tensor, y: Tensor) -> Tensor:
        """Sum over networks of the negative log likelihood (equation 1 of the paper, without its constant), with
        weight decay and limits of the variance."""
        mean, log_variance = self(x)
        limits = self.highest.sum() - self.lowest.sum()
        total = negative_log_likelihood(mean, log_variance, y) + LIMIT_WEIGHT * limits
        for rate, weight in zip(self._decay, self.weights, strict=True):
            total = total + rate * (weight**2).sum() / 2
        return total


def negative_log_likelihood(mean: Tensor, log_variance: Tensor, y: Tensor) -> Tensor:
    """Sum over networks of the mean over samples and outputs of (mean - y)^2 / variance + log variance."""
    return (((mean - y) ** 2) * torch.exp(-log_variance) + log_variance).mean((-2, -1)).sum()


def train(
    model: Ensemble,
    optimizer: torch.optim.Optimizer,
    x: Tensor,
    y: Tensor,
    epochs: int,
    batch: int,
    check: Callable[[], None],
) -> None:
    """Train each network on its own bootstrap sample of inputs (n, I) and outputs (n, E)."""
    networks, n = len(model.weights[0]), len(x)
    model.scale_by(x)
    chosen = torch.randint(n, (networks, n))
    for _ in range(epochs):
        chosen = torch.gather(chosen, 1, torch.rand(networks, n).argsort(1))
        for at in torch.split(chosen, batch, 1):
            check()
            optimizer.zero_grad()
            model.loss(x[at], y[at]).backward()  # type: ignore[no-untyped-call]
            optimizer.step()


def moments(values: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and deviation (E,) of values (n, E); a constant has a deviation of one."""
    deviation = values.std(0)
    return values.mean(0), torch.where(deviation < 1e-6, torch.ones_like(deviation), deviation)
