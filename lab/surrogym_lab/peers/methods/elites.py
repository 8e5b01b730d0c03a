"""Training of an ensemble with a held-out part, as MBPO does it: the best networks, each at its best epoch (torch).

M. Janner et al., "When to Trust Your Model: Model-Based Policy Optimization", NeurIPS 2019; bnn.py of the authors'.

Shapes: B networks, n samples, I inputs, E outputs.
"""

from __future__ import annotations

import copy
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn

from surrogym_lab.peers.methods.ensemble import Ensemble

HELD_OUT, MOST = 0.2, 5_000  # share of samples, and the largest number
PATIENCE, LEAST = 5, 0.01  # epochs without an improvement by this share
BATCH = 256
CHUNK = 5_000  # samples of a network at once


class Trained:
    """The elites of an ensemble."""

    def __init__(self, model: Ensemble, elites: Tensor) -> None:
        self.elites = elites
        self._model = copy.deepcopy(model)
        self._model.weights = nn.ParameterList(part.detach()[elites] for part in model.weights)
        self._model.biases = nn.ParameterList(part.detach()[elites] for part in model.biases)

    @torch.no_grad()
    def drawn(self, x: Tensor) -> Tensor:
        """Outputs (n, E) at inputs (n, I), each drawn from the distribution of a random elite. Each elite gets as many
        inputs."""
        count = len(self.elites)
        order = torch.cat([torch.randperm(len(x)), torch.randint(len(x), (-len(x) % count,))]).reshape(count, -1)
        found = []
        for at in torch.split(order, CHUNK, 1):
            mean, log_variance = self._model(x[at])
            found.append(mean + torch.exp(log_variance / 2) * torch.randn_like(mean))
        outputs = torch.empty(len(x), found[0].shape[-1])
        outputs[order.flatten()] = torch.cat(found, 1).flatten(0, 1)
        return outputs


def fit(
    model: Ensemble,
    optimizer: torch.optim.Optimizer,
    x: Tensor,
    y: Tensor,
    elites: int,
    least: int,
    rng: np.random.Generator,
    check: Callable[[], None],
) -> Trained:
    """Train each network on its own bootstrap sample, until no held-out error has improved for five epochs.

    The ensemble itself gets the best epoch of each network.

    Args:
        model: continued from where it is.
        optimizer: of its parameters.
        x, y: inputs (n, I) and outputs (n, E).
        elites: number of networks to keep, those with the smallest held-out errors.
        least: steps of an epoch. With fewer batches than this, an epoch passes the samples several times.
        rng: random generator.
        check: called before each step.
    """
    networks, held = len(model.weights[0]), min(int(HELD_OUT * len(x)), MOST)
    order = torch.from_numpy(rng.permutation(len(x)))
    out, rest = order[:held], order[held:]
    model.scale_by(x[rest])
    chosen = rest[torch.from_numpy(rng.integers(len(rest), size=(networks, len(rest))))]
    passes = -(-least // -(-len(rest) // BATCH))  # both divisions round up
    own = [*model.weights, *model.biases]
    kept, best = [part.detach().clone() for part in own], torch.full((networks,), torch.inf)
    waited = 0
    while waited <= PATIENCE:
        for _ in range(passes):
            for at in torch.split(chosen, BATCH, 1):
                check()
                optimizer.zero_grad()
                model.loss(x[at], y[at]).backward()  # type: ignore[no-untyped-call]
                optimizer.step()
            chosen = torch.gather(chosen, 1, torch.from_numpy(rng.random(chosen.shape)).argsort(1))
        errors = held_out(model, x[out], y[out])
        better = ~(errors >= best * (1 - LEAST))
        best = torch.where(better, errors, best)
        for part, of in zip(kept, own, strict=True):
            part[better] = of.detach()[better]
        waited = 0 if better.any() else waited + 1
    with torch.no_grad():
        for part, of in zip(kept, own, strict=True):
            of.copy_(part)
    return Trained(model, held_out(model, x[out], y[out]).argsort()[:elites])


@torch.no_grad()
def held_out(model: Ensemble, x: Tensor, y: Tensor) -> Tensor:
    """Mean squared errors (B,) of the networks' means."""
    mean, _ = model(x.expand(len(model.weights[0]), -1, -1))
    errors: Tensor = ((mean - y) ** 2).mean((1, 2))
    return errors
