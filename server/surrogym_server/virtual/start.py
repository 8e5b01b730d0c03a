"""Start of an episode: from the declared distribution or anywhere in the sampling range, and the initial particles."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.step_rules import settle
from surrogym_server.virtual.lanes import LaneState
from surrogym_server.virtual.noise import Purpose, normal_noise, uniform_noise


def start_coordinates(
    definition: EnvironmentDefinition,
    lanes: LaneState,
    box_share: float,
    visited_share: float = 0.0,
    visited: Tensor | None = None,
) -> Tensor:
    """Start of each lane's current episode, (N, C). A share of the episodes starts anywhere in the sampling range, and
    another share at one of the states ``visited`` (k, C)."""
    coordinates = definition.coordinates
    p = uniform_noise(lanes, Purpose.START, len(coordinates))
    if definition.starts:
        declared = _one_of(definition.start_states, p[:, 0])
    else:
        declared = torch.stack([c.start.quantile(p[:, i]) for i, c in enumerate(coordinates)], -1)
    if box_share == 0 and visited_share == 0:
        return declared
    anywhere = torch.stack([c.sampling.quantile(p[:, i]) for i, c in enumerate(coordinates)], -1)
    kind = uniform_noise(lanes, Purpose.BOX_START, 1)
    if visited is not None:
        declared = torch.where(kind < box_share + visited_share, _one_of(visited, p[:, 0]), declared)
    return torch.where(kind < box_share, anywhere, declared)


def _one_of(states: Tensor, p: Tensor) -> Tensor:
    """The state (N, C) of ``states`` (k, C) at each of the shares p (N,), in [0, 1)."""
    return states[(p * len(states)).long().clamp_(max=len(states) - 1)]


def start_particles(
    definition: EnvironmentDefinition, lanes: LaneState, q: Tensor, count: int, spread: float
) -> Tensor:
    """Initial particles (N, P, C) around starts q (N, C): normal, with a fixed small standard deviation in each
    dimension (section 4)."""
    each = [_std(definition, i, spread) for i in range(len(definition.coordinates))]
    std = torch.tensor(each, dtype=q.dtype, device=q.device)
    noise = normal_noise(lanes, Purpose.SPREAD, count, len(definition.coordinates))
    return settle(definition, q[:, None] + std * noise)


def _std(definition: EnvironmentDefinition, index: int, spread: float) -> float:
    coordinate = definition.coordinates[index]
    if coordinate.kind == "constant":
        return 0.0
    width = 2 * math.pi if coordinate.kind == "angle" else coordinate.sampling.high - coordinate.sampling.low
    return spread * width
