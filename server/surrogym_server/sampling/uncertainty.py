"""Uncertainty of a model at given points, and in the states that policies visit, as numpy arrays."""

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
    """Prediction and uncertainty at n points, arrays (n, O) with the outputs in the order of ``definition.outputs``."""

    mean: (
        Array  # predicted change of each coordinate, or of each observation entry that the model moves; then the reward
    )
    std: Array
    model_uncertainty: Array
    input_probability: Array
    log_uncertainty_index: Array


def query_uncertainty(
    model: DynamicsModel, q: Array, u: Array, tolerances: Array, occupancy: Array | None = None
) -> UncertaintyResult:
    """Return mean, standard deviation, U_m, P_i and log U at q (n, C) and u (n, F), for tolerances (O,)."""
    at, action = torch.from_numpy(q), torch.from_numpy(u)
    states = None if occupancy is None else torch.from_numpy(occupancy)
    mean, std = model.means(at, action), stds(model, at, action)
    log_p = input_probability(model, Points(at, action), states)[:, None].expand_as(std)
    log_u_m = log_model_uncertainty(std, torch.from_numpy(tolerances))
    parts = (mean, std, log_u_m.exp(), log_p.exp(), log_uncertainty_index(log_u_m, log_p))
    return UncertaintyResult(*(p.numpy() for p in parts))


def visited_confidence(model: DynamicsModel, states: Array, tolerances: Sequence[float]) -> float:
    """Smallest confidence index (eq. 8, 9) of the outputs over visited states (v, C), for tolerances (O,).

    With these states in the place of the Monte Carlo set, it shows how well the model is known where a policy goes.

    States outside the sampling range count as well, although the design never queries there. Each state is taken under
    one random action, as in the acquisition's reference, because a policy that learns tries actions other than its own.
    """
    definition = model.definition
    rng = np.random.default_rng(definition.design.seed)
    points = under_random_actions(definition, torch.from_numpy(states), rng)
    sure = certainty(stds(model, points.q, points.u), torch.tensor(tolerances, dtype=torch.float64))
    return float(sure.mean(0).min())
