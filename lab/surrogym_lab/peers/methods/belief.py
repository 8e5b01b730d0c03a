"""Beliefs of PILCO over the coordinates, and the expected costs of an episode (torch).

``next_belief`` is the reference of the compiled code that follows an episode, ``Imagination``.

Shapes: H steps, K beliefs, C coordinates, F controls, P pairs of coordinates.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from surrogym_lab.peers.methods.fast_pilco.beliefs import Exact
from surrogym_lab.peers.methods.fast_pilco.beliefs import backward as passed_back
from surrogym_lab.peers.methods.fast_pilco.beliefs import forward as followed
from surrogym_lab.peers.methods.gaussian_process import Processes
from surrogym_lab.peers.methods.moments import (
    Moments,
    saturating_cost,
    squashed,
    through_angles,
    through_processes,
)
from surrogym_lab.peers.methods.states import States
from surrogym_lab.peers.methods.told import TipCost


class Joint:
    """A belief over a growing list of variables: mean (K, V) and covariance (K, V, V)."""

    def __init__(self, mean: Tensor, covariance: Tensor) -> None:
        self.mean = mean
        self.covariance = covariance

    def of(self, at: Sequence[int]) -> tuple[Tensor, Tensor]:
        return self.mean[:, at], self.covariance[:, at][:, :, at]

    def append(self, at: Sequence[int], new: Moments) -> list[int]:
        """Append outputs of a function of the variables ``at``. Returns their places."""
        cross = self.covariance[:, :, at] @ new.gain
        first = self.mean.shape[1]
        self.mean = torch.cat([self.mean, new.mean], 1)
        upper = torch.cat([self.covariance, cross], 2)
        self.covariance = torch.cat([upper, torch.cat([cross.mT, new.covariance], 2)], 1)
        return list(range(first, self.mean.shape[1]))


def next_belief(
    states: States, model: Processes, policy: Processes, mean: Tensor, covariance: Tensor
) -> tuple[Tensor, Tensor]:
    """Belief over the coordinates after one control (equations 9 to 11 of the paper)."""
    joint, size = Joint(mean, covariance), mean.shape[1]
    angles = np.flatnonzero(states.angles).tolist()
    trigonometric = joint.append(angles, through_angles(*joint.of(angles)))
    sines, cosines = trigonometric[: len(angles)], trigonometric[len(angles) :]
    features = [*np.flatnonzero(~states.angles).tolist(), *cosines, *sines]
    wanted = joint.append(features, through_processes(policy, *joint.of(features), certain=True))
    controls = joint.append(wanted, squashed(*joint.of(wanted)))
    inputs = [*features, *controls]
    changes = joint.append(inputs, through_processes(model, *joint.of(inputs)))
    before, both = list(range(size)), joint.covariance
    cross = both[:, before][:, :, changes]
    reached = both[:, before][:, :, before] + cross + cross.mT + both[:, changes][:, :, changes]
    return joint.mean[:, before] + joint.mean[:, changes], (reached + reached.mT) / 2


def costs_of(cost: TipCost, mean: Tensor, covariance: Tensor) -> Tensor:
    """Expected costs (K,) of beliefs over coordinates."""
    angles, linear, sines, cosines = map(torch.from_numpy, (cost.angles, cost.linear, cost.sines, cost.cosines))
    joint, at = Joint(mean, covariance), list(range(mean.shape[1]))
    turned = Moments(mean @ angles.T, angles @ covariance @ angles.T, angles.T.expand(len(mean), -1, -1))
    places = joint.append(at, turned)
    joint.append(places, through_angles(*joint.of(places)))
    tip = torch.cat([linear, torch.zeros_like(sines), sines, cosines], 1)
    return saturating_cost(joint.mean @ tip.T, tip @ joint.covariance @ tip.T, torch.from_numpy(cost.goal), cost.width)


class Imagination:
    """Imagined episodes through a model, in compiled code.

    Args:
        states: how the coordinates are seen.
        model: processes from features and controls to changes of coordinates.
    """

    def __init__(self, states: States, model: Processes) -> None:
        first, second = np.triu_indices(len(model.signal))
        self.model = exact(model)
        weights = self.model[3]
        self.by_pairs = weights[first][:, :, None] * weights[second][:, None]
        self.by_pairs[first == second] -= model.inverse.numpy()
        size, angles, controls = len(states.angles), int(states.angles.sum()), states.controls
        turning, linear = np.flatnonzero(states.angles), np.flatnonzero(~states.angles)
        sines, cosines = size + np.arange(angles), size + angles + np.arange(angles)
        wanted = size + 2 * angles + np.arange(controls)
        features = np.concatenate([linear, cosines, sines])
        changes = wanted[-1] + controls + 1 + np.arange(size)
        self.places = (turning, features, wanted, np.concatenate([features, wanted + controls]), changes)

    def __call__(self, policy: Processes, mean: Tensor, covariance: Tensor, horizon: int) -> tuple[Tensor, Tensor]:
        """Means (H, K, C) and covariances (H, K, C, C) after each control, from beliefs about the start. Gradients are
        those by the policy's centres, length scales and weights."""
        found: tuple[Tensor, Tensor] = _Imagined.apply(  # type: ignore[no-untyped-call]
            policy.x, policy.lengthscale, policy.weights, policy.signal, self, mean, covariance, horizon
        )
        return found


class _Imagined(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        x: Tensor,
        lengthscale: Tensor,
        weights: Tensor,
        signal: Tensor,
        through: Imagination,
        mean: Tensor,
        covariance: Tensor,
        horizon: int,
    ) -> tuple[Tensor, Tensor]:
        count, size = mean.shape
        inputs, pairs = through.places[3].size, len(through.by_pairs)
        variables = int(through.places[4][-1]) + 1
        joints, covariances = np.empty((horizon, count, variables)), np.empty((horizon, count, variables, variables))
        slopes = np.empty((horizon, count, pairs, inputs * (inputs + 1)))
        means, own = np.empty((horizon + 1, count, size)), np.empty((horizon + 1, count, size, size))
        means[0], own[0] = mean.numpy(), covariance.numpy()
        ctx.policy = tuple(np.ascontiguousarray(part.detach().numpy()) for part in (x, lengthscale, signal, weights))
        ctx.through, ctx.passed = through, (joints, covariances, slopes)
        followed(through.model, through.by_pairs, ctx.policy, through.places, joints, covariances, slopes, means, own)
        return torch.from_numpy(means[1:]), torch.from_numpy(own[1:])

    @staticmethod
    def backward(ctx: Any, by_means: Tensor, by_own: Tensor) -> Any:
        (x, lengthscale, _, weights), (joints, covariances, slopes) = ctx.policy, ctx.passed
        by_policy = np.zeros_like(x), np.zeros_like(lengthscale), np.zeros_like(weights)
        means, own = (np.concatenate([np.zeros_like(part[:1]), part]) for part in (by_means.numpy(), by_own.numpy()))
        through = ctx.through
        passed_back(through.model, ctx.policy, through.places, joints, covariances, slopes, means, own, by_policy)
        return *map(torch.from_numpy, by_policy), *(None,) * 5


def exact(model: Processes) -> Exact:
    """Samples, length scales, signals and weights of processes."""
    x, lengthscale, signal, weights = (
        np.ascontiguousarray(part.detach().numpy())
        for part in (model.x, model.lengthscale, model.signal, model.weights)
    )
    return x, lengthscale, signal, weights


def expected_cost(
    imagination: Imagination, cost: TipCost, beliefs: tuple[Tensor, Tensor], horizon: int, policy: Processes
) -> Tensor:
    """Expected cost of an episode, mean over the beliefs of starts (equation 2 of the paper)."""
    means, covariances = imagination(policy, *beliefs, horizon)
    return costs_of(cost, means.flatten(0, 1), covariances.flatten(0, 1)).sum() / len(beliefs[0])
