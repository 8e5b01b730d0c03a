"""Prediction of single steps without a session, as NumPy arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from surrogym_server.environment.step_rules import paid
from surrogym_server.models.guard import require_shapes
from surrogym_server.models.port import DynamicsModel

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PointPrediction:
    next_coordinates: Array  # (n, C) predicted coordinates after the step from each of n states
    next_observation: Array  # (n, D) observation after the step from each of n states
    reward: Array  # (n,) predicted mean reward of each step, without a penalty for uncertainty
    reward_std: Array  # (n,) predicted standard deviation of each step's reward
    terminated: NDArray[Any]  # (n,) bool: whether the step ends the episode


def predict_points(model: DynamicsModel, q: Array, u: Array) -> PointPrediction:
    """Predict one step from each of n states q (n, C) under actions u (n, F), by the means of the model's outputs."""
    at, action = torch.from_numpy(q), torch.from_numpy(u)
    predicted = model.transition(at, action, reward_std=True)
    require_shapes(model, predicted, at)
    q_next, std = predicted.q_next, predicted.reward_std
    assert std is not None
    over = model.terminated(q_next)
    reward, observation = paid(model.terminal_reward, predicted.reward, over), model.definition.observe(q_next)
    return PointPrediction(*(t.numpy() for t in (q_next, observation, reward, std, over)))
