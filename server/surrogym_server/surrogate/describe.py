"""The stateless transition, as numpy for the edge."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from surrogym_server.surrogate.model import SurrogateModel

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PointPrediction:
    next_coordinates: Array  # (n, C)
    next_observation: Array  # (n, D)
    reward: Array  # (n,) mean, without the penalty
    reward_deviation: Array  # (n,)
    terminated: NDArray[Any]  # (n,) bool


def predict_points(model: SurrogateModel, q: Array, u: Array) -> PointPrediction:
    """One mean step from each of q (n, C) under u (n, F)."""
    at, action = torch.from_numpy(q), torch.from_numpy(u)
    q_next = model.transition(at, action).q_next
    over = model.definition.terminated(q_next)
    reward, deviation = model.predict_reward(at, action, q_next, over)
    assert deviation is not None
    observation = model.definition.observe(q_next)
    return PointPrediction(*(t.numpy() for t in (q_next, observation, reward, deviation, over)))
