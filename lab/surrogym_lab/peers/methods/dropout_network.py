"""A network with dropout as an approximate Bayesian one: a mask of its units is a draw of its weights (torch).

Y. Gal, Z. Ghahramani, "Dropout as a Bayesian Approximation", ICML 2016.

Shapes: n samples, I inputs, E outputs, H units of each of two layers.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from surrogym_lab.peers.methods.ensemble import moments

Masks = tuple[Tensor, Tensor]
"""Factors (n, H) of the units of both layers: 0, or 1 / (1 - rate)."""


class DropoutNetwork(nn.Module):
    """Two layers of rectified units, in single precision between inputs and outputs in double precision, which are
    scaled by the samples' mean and deviation.

    Args:
        inputs, outputs: numbers I and E.
        hidden: H.
        rate: share of the units that a mask leaves out.
    """

    def __init__(self, inputs: int, outputs: int, hidden: int, rate: float) -> None:
        super().__init__()
        self._rate = rate
        self.first = nn.Linear(inputs, hidden)
        self.second = nn.Linear(hidden, hidden)
        self.last = nn.Linear(hidden, outputs)
        unscaled = torch.tensor([[0.0], [1.0]]).double()
        self.scales = unscaled.expand(2, inputs), unscaled.expand(2, outputs)

    def scale_by(self, x: Tensor, y: Tensor) -> None:
        """Take means and deviations of inputs (n, I) and outputs (n, E)."""
        self.scales = torch.stack(moments(x)), torch.stack(moments(y))

    def masks(self, count: int) -> Masks:
        """Draw masks, one for each of n samples."""
        keep = 1 - self._rate
        first, second = torch.bernoulli(torch.full((2, count, self.second.in_features), keep)) / keep
        return first, second

    def forward(self, x: Tensor, masks: Masks) -> Tensor:
        """Outputs (n, E) at inputs (n, I), each of its own draw of the weights."""
        (middle, spread), (out_middle, out_spread) = self.scales
        inner = torch.relu(self.first(((x - middle) / spread).float())) * masks[0]
        inner = torch.relu(self.second(inner)) * masks[1]
        outputs: Tensor = out_middle + out_spread * self.last(inner).double()
        return outputs


def train(
    model: DropoutNetwork,
    optimizer: torch.optim.Optimizer,
    x: Tensor,
    y: Tensor,
    steps: int,
    batch: int,
    check: Callable[[], None],
) -> None:
    """Continue the training with squared errors of scaled outputs, each sample with a mask of its own.

    The optimizer's weight decay is the prior of the weights. ``check`` is called before each step. Afterwards the
    weights have no gradients, which would cost a search through the network half of its time.
    """
    model.scale_by(x, y)
    model.requires_grad_(True)
    spread = model.scales[1][1]
    for _ in range(steps):
        check()
        at = torch.randperm(len(x))[:batch]
        optimizer.zero_grad()
        error = (model(x[at], model.masks(len(at))) - y[at]) / spread
        (error**2).mean().backward()
        optimizer.step()
    model.requires_grad_(False)
