"""Rules of a step that apply to every model: limits, walls, wrapped angles, lags, and the terminal reward."""

from __future__ import annotations

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition, wrap
from surrogym_server.environment.observation_inverse import ObservationInverse


def paid(terminal_reward: float, reward: Tensor, terminated: Tensor) -> Tensor:
    """Return the rewards (m,) of m steps, with the terminal reward added where ``terminated`` (m,) is true."""
    return reward + terminal_reward * terminated if terminal_reward else reward


def clip(definition: EnvironmentDefinition, q: Tensor) -> Tensor:
    """Return coordinates q (..., C), clipped to their declared bounds, or to ``EnvironmentDefinition.reach`` on a side
    without a bound."""
    low, high = definition.reach
    return torch.clamp(q, low, high)


def settle(definition: EnvironmentDefinition, q: Tensor) -> Tensor:
    """Return coordinates q (..., C) with the rules of the environment applied: they are clipped to bounds, a speed that
    points into a wall becomes 0, and angles are wrapped."""
    inside = clip(definition, q)
    for index, (coordinate, stopped) in enumerate(zip(definition.coordinates, definition.stopped, strict=True)):
        if stopped is not None:
            low, high = coordinate.saturation
            speed = inside[..., stopped]
            into_low = (inside[..., index] <= low) & (speed < 0)
            into_high = (inside[..., index] >= high) & (speed > 0)
            inside[..., stopped] = speed.masked_fill(into_low | into_high, 0.0)
        if coordinate.kind == "angle":
            inside[..., index] = wrap(inside[..., index])
    return inside


def placed(definition: EnvironmentDefinition, change: Tensor) -> Tensor:
    """Convert predicted changes (m, M) of the moving coordinates to changes (m, C) of all C coordinates, 0 for those
    that don't move. If the environment's model predicts changes of the observation instead (preset ``paper``),
    ``change`` (m, D) has these, and the result is ``change`` itself."""
    if definition.moves_observation:
        return change
    every = change.new_zeros(len(change), len(definition.coordinates))
    return every.index_copy(1, definition.moving_columns, change)


def moved(
    definition: EnvironmentDefinition, inverse: ObservationInverse | None, q: Tensor, u: Tensor, change: Tensor
) -> Tensor:
    """Return the next coordinates (m, C), given predicted changes. The environment's rules, such as limits, are applied
    to them, and lags (coordinates that repeat a past value) are set.

    Args:
        definition: the environment.
        inverse: inverse of the observation if the model predicts changes of the observation, otherwise None.
        q: coordinates (m, C) before the step.
        u: actions (m, F).
        change: predicted change of the coordinates, (m, C), if ``inverse`` is None, otherwise of the observation, (m,
            D).
    """
    arrived = q + change if inverse is None else inverse(definition.observe(q) + change, q)
    return with_lags(definition, q, u, settle(definition, arrived))


def with_lags(definition: EnvironmentDefinition, q: Tensor, u: Tensor, q_next: Tensor) -> Tensor:
    """Return the next coordinates q_next (m, C) of m steps from q (m, C) under actions u (m, F), with lags set. A lag
    is a coordinate that repeats a past value."""
    if not definition.lags:
        return q_next
    repeated = [_repeated(definition, index, q, u, q_next) for index in definition.lags]
    return clip(definition, q_next.index_copy(1, definition.lag_columns, torch.stack(repeated, 1)))


def _repeated(definition: EnvironmentDefinition, index: int, q: Tensor, u: Tensor, q_next: Tensor) -> Tensor:
    """Return the value (m,) of the coordinate ``index``, which is a lag (it repeats a past value), after each of m
    steps from q (m, C) under u (m, F) to q_next (m, C)."""
    lag, source = definition.coordinates[index].lag, definition.sources[index]
    assert lag is not None
    match lag.kind:
        case "action":
            return u[:, source - len(definition.coordinates)].to(q.dtype)
        case "value":
            return q[:, source]
        case "steps":
            return q[:, source] + 1
        case "change":
            change = q_next[:, source] - q[:, source]
            return wrap(change) if definition.coordinates[source].kind == "angle" else change
