"""Start of an episode: from the declared distribution or anywhere in the sampling range, and the initial particles."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.step_rules import settle
from surrogym_server.virtual.lanes import LaneState
from surrogym_server.virtual.noise import Purpose, normal_noise, uniform_noise


def start_coordinates(definition: EnvironmentDefinition, lanes: LaneState, box_share: float) -> Tensor:
    """Start of each lane's current episode, (N, C). A share of the episodes starts anywhere in the sampling range."""
    coordinates = definition.coordinates
    p = uniform_noise(lanes, Purpose.START, len(coordinates))
    if definition.starts:
        states = definition.start_states
        declared = states[(p[:, 0] * len(states)).long().clamp_(max=len(states) - 1)]
    else:
        declared = torch.stack([c.start.quantile(p[:, i]) for i, c in enumerate(coordinates)], -1)
    if box_share == 0:
        return declared
    anywhere = torch.stack([c.sampling.quantile(p[:, i]) for i, c in enumerate(coordinates)], -1)
    in_box = uniform_noise(lanes, Purpose.BOX_START, 1) < box_share
    return torch.where(in_box, anywhere, declared)


def start_particles(
    definition: EnvironmentDefinition, lanes: LaneState, q: Tensor, count: int, spread: float
) -> Tensor:
    """Initial particles (N, P, C) around starts q (N, C): normal, with a fixed small deviation in each dimension
    (section 4)."""
    each = [_deviation(definition, i, spread) for i in range(len(definition.coordinates))]
    deviation = torch.tensor(each, dtype=q.dtype, device=q.device)
    noise = normal_noise(lanes, Purpose.SPREAD, count, len(definition.coordinates))
    return settle(definition, q[:, None] + deviation * noise)


def _deviation(definition: EnvironmentDefinition, index: int, spread: float) -> float:
    coordinate = definition.coordinates[index]
    if coordinate.kind == "constant":
        return 0.0
    width = 2 * math.pi if coordinate.kind == "angle" else coordinate.sampling.high - coordinate.sampling.low
    return spread * width
