"""Uncertainty of a model at given states and actions, and in the states that policies visit, as numpy arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from surrogym_server.environment.points import Points
from surrogym_server.models.port import DynamicsModel
from surrogym_server.sampling.candidates import input_probability, under_random_actions
from surrogym_server.sampling.confidence import certainty, log_model_uncertainty, log_uncertainty_index, stds

Array = NDArray[np.float64]


@dataclass(frozen=True)
class UncertaintyResult:
    """Predictions and uncertainties at n points. Arrays are (n, O), with the outputs in the order of
    ``definition.outputs``."""

    mean: Array  # predicted change of each moving coordinate or observation entry; in the last column the reward
    std: Array  # standard deviation without noise, in the output's unit
    model_uncertainty: Array  # U_m = Phi(-tolerance / std), between 0 and 0.5 (eq. 10)
    input_probability: Array  # density P_i of the states that policies visited over the uniform density (eq. 11)
    log_uncertainty_index: Array  # log U = log U_m + log P_i, the logarithm of the paper's uncertainty index (eq. 12)


def query_uncertainty(
    model: DynamicsModel, q: Array, u: Array, tolerances: Array, occupancy: Array | None = None
) -> UncertaintyResult:
    """Return predictions and uncertainties at n points.

    Args:
        model: the model with O outputs.
        q, u: coordinates (n, C) and actions (n, F) of the points.
        tolerances: (O,) tolerance of each output, in its unit.
        occupancy: (v, C) states that policies visited, or None.
    """
    at, action = torch.from_numpy(q), torch.from_numpy(u)
    states = None if occupancy is None else torch.from_numpy(occupancy)
    mean, std = model.means(at, action), stds(model, at, action)
    log_p = input_probability(model, Points(at, action), states)[:, None].expand_as(std)
    log_u_m = log_model_uncertainty(std, torch.from_numpy(tolerances))
    parts = (mean, std, log_u_m.exp(), log_p.exp(), log_uncertainty_index(log_u_m, log_p))
    return UncertaintyResult(*(p.numpy() for p in parts))


def visited_confidence(model: DynamicsModel, states: Array, tolerances: Sequence[float]) -> float:
    """Return the smallest confidence index (eq. 8, 9) of the outputs over visited states (v, C), for tolerances (O,).

    It shows how well the model knows the outputs where a policy goes, whereas the Monte Carlo set covers the whole
    range.

    States outside the sampling range count too, although the design requests no real steps there. Each state has one
    random action, because a policy tries many actions while it learns.
    """
    definition = model.definition
    rng = np.random.default_rng(definition.design.seed)
    points = under_random_actions(definition, torch.from_numpy(states), rng)
    sure = certainty(stds(model, points.q, points.u), torch.tensor(tolerances, dtype=torch.float64))
    return float(sure.mean(0).min())
