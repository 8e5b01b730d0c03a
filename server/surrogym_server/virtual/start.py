"""Start of an episode: states from the declared distribution or elsewhere, and initial particles."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.distributions import quantiles
from surrogym_server.environment.step_rules import settle
from surrogym_server.tensors import constant
from surrogym_server.virtual.lanes import LaneState
from surrogym_server.virtual.noise import Purpose, normal_noise, uniform_noise
from surrogym_shared.spec import limits


def start_coordinates(
    definition: EnvironmentDefinition,
    lanes: LaneState,
    box_share: float,
    visited_share: float = 0.0,
    visited: Tensor | None = None,
) -> Tensor:
    """Draw the first state of the current episode of each of N lanes, (N, C).

    Args:
        definition: the environment.
        lanes: state of the lanes, whose keys and episode numbers determine the draw.
        box_share: share of the episodes whose start is drawn from the sampling distributions, anywhere in the sampling
            range.
        visited_share: share of the episodes that start at one of the states ``visited``.
        visited: (k, C) states at which episodes can start, or None if ``visited_share`` is 0.
    """
    p = uniform_noise(lanes, Purpose.START, len(definition.coordinates))
    if definition.starts:
        declared = _one_of(definition.start_states, p[:, 0])
    else:
        declared = quantiles(definition.start, p)
    if box_share == 0 and visited_share == 0:
        return declared
    anywhere = quantiles([c.sampling for c in definition.coordinates], p)
    kind = uniform_noise(lanes, Purpose.BOX_START, 1)
    if visited is not None:
        declared = torch.where(kind < box_share + visited_share, _one_of(visited, p[:, 0]), declared)
    return torch.where(kind < box_share, anywhere, declared)


def _one_of(states: Tensor, p: Tensor) -> Tensor:
    """Return N rows (N, C) of ``states`` (k, C), one for each of N numbers p (N,) in [0, 1). A number p selects the row
    with the index floor(k p)."""
    return states[(p * len(states)).long().clamp_(max=len(states) - 1)]


def start_particles(
    definition: EnvironmentDefinition, lanes: LaneState, q: Tensor, count: int, spread: float
) -> Tensor:
    """Draw initial particles (N, P, C) around the first states q (N, C), with P = ``count``. They are normally
    distributed; the standard deviation is ``spread`` times the range of each coordinate (section 4 of the paper)."""
    std = constant(tuple(_std(definition, i, spread) for i in range(len(definition.coordinates))), q.device)
    noise = normal_noise(lanes, Purpose.SPREAD, count, len(definition.coordinates))
    return settle(definition, q[:, None] + std * noise)


def _std(definition: EnvironmentDefinition, index: int, spread: float) -> float:
    coordinate = definition.coordinates[index]
    if coordinate.kind == "constant":
        return 0.0
    low, high = (-math.pi, math.pi) if coordinate.kind == "angle" else limits(coordinate.sampling)
    return spread * (high - low)
