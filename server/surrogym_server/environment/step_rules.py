"""Rules of a step, whatever model predicts it: limits, walls, wrapped angles, and what an end pays."""

from __future__ import annotations

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition, wrap
from surrogym_server.environment.observation_inverse import ObservationInverse


def paid(terminal_reward: float, reward: Tensor, terminated: Tensor) -> Tensor:
    """Rewards (m,), with what steps that end the episode, terminated (m,), pay beyond."""
    return reward + terminal_reward * terminated if terminal_reward else reward


def clip(definition: EnvironmentDefinition, q: Tensor) -> Tensor:
    """Coordinates q (..., C) inside their saturation bounds, and a diverging model's within its reach."""
    low, high = definition.reach
    return torch.clamp(q, low, high)


def settle(definition: EnvironmentDefinition, q: Tensor) -> Tensor:
    """Coordinates as the environment leaves them: clipped, stopped at walls, angles wrapped. q (..., C)."""
    inside = clip(definition, q)
    for index, coordinate in enumerate(definition.coordinates):
        if coordinate.stops is not None:
            speed = inside[..., coordinate.stops]
            into_low = (inside[..., index] <= coordinate.low) & (speed < 0)
            into_high = (inside[..., index] >= coordinate.high) & (speed > 0)
            inside[..., coordinate.stops] = torch.where(into_low | into_high, 0.0, speed)
        if coordinate.kind == "angle":
            inside[..., index] = wrap(inside[..., index])
    return inside


def placed(definition: EnvironmentDefinition, change: Tensor) -> Tensor:
    """Changes (m, M) of the moving coordinates as changes (m, C) of all, as ``moved`` takes them. Changes of the
    observation stay as they are."""
    if definition.moves_observation:
        return change
    every = change.new_zeros(len(change), len(definition.coordinates))
    return every.index_copy(1, definition.moving_columns, change)


def moved(definition: EnvironmentDefinition, inverse: ObservationInverse | None, q: Tensor, change: Tensor) -> Tensor:
    """Where coordinates q (m, C) arrive that change by (m, C), or whose observation does, by (m, D), given its inverse;
    as the environment leaves them."""
    arrived = q + change if inverse is None else inverse(definition.observe(q) + change, q)
    return settle(definition, arrived)
