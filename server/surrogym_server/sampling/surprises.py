"""Errors with which the latest model predicts new samples, before the next model learns from them."""

from __future__ import annotations

import torch

from surrogym_server.environment.samples import Samples, increments, saturated
from surrogym_server.models.port import DynamicsModel

Surprises = tuple[tuple[float, ...], ...]  # the errors of each output (O,), in its unit, the oldest sample first


def surprises_of(model: DynamicsModel, samples: Samples) -> Surprises:
    """Return for each output the true values of samples that the model has not learned from, less the predictions.

    Outputs of steps that ended at a declared limit are left out, because the limit cuts the change off. Rewards of
    steps that ended the episode are left out, because they contain the terminal reward.
    """
    reward = model.transition(samples.q, samples.u).reward
    mean = torch.cat([model.means(samples.q, samples.u)[:, :-1], reward[:, None]], -1)
    error = torch.cat([increments(model.definition, samples), samples.reward[:, None]], -1) - mean
    usable = error.isfinite()
    if not model.definition.moves_observation:
        usable[:, :-1] &= ~saturated(model.definition, samples.q_next)[:, None]
    usable[:, -1] &= ~samples.terminated
    return tuple(tuple(error[rows, i].tolist()) for i, rows in enumerate(usable.T))
