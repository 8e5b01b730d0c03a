"""Find samples that ended at a bound. Their increments are cut off there, so they say little about the dynamics."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.features import FeatureMap, leading
from surrogym_server.environment.samples import saturated


def usable(
    definition: EnvironmentDefinition, column: int, q_next: Tensor, feature_map: FeatureMap, *, past_limits: bool
) -> Tensor:
    """Return (m,) bool: for each of m samples, with next states q_next (m, C), whether a transition output learns from
    it. It does not learn from samples whose result a limit may have changed.

    Args:
        definition: the environment.
        column: index of the transition output.
        q_next: states in which the samples ended.
        feature_map: features that the output's process reads.
        past_limits: whether the output also learns from samples that end at a limit of another coordinate.
    """
    if definition.moves_observation:
        return torch.ones(len(q_next), dtype=torch.bool)
    if past_limits:
        return ~stopped(definition, definition.moving[column], q_next)
    if feature_map.lead:
        return ~saturates(definition, definition.moving[column], q_next)
    return ~saturated(definition, q_next)


def stopped(definition: EnvironmentDefinition, index: int, q_next: Tensor) -> Tensor:
    """Return (n,) bool: for each of n samples, with next states q_next (n, C), whether it reached a bound that may have
    changed the result of the coordinate ``index``. Such a bound is one of this coordinate, or a wall, at which another
    coordinate, such as a speed, becomes 0.

    A limit of another coordinate that is no wall, such as the pressure limit of a relief valve, does not count.
    """
    limits = [i for i in definition.moving if i != index and definition.stopped[i] is None]
    others = q_next.clone()
    others[:, limits] = math.nan
    return saturated(definition, others)


def saturates(definition: EnvironmentDefinition, index: int, q_next: Tensor) -> Tensor:
    """Return (n,) bool: for each of n samples, with next states q_next (n, C), whether it reached a bound of the
    coordinate ``index`` or of another coordinate. Leading coordinates (see ``features.leading``) don't count as other
    coordinates, because their clipped next values can be inputs of the output."""
    others = q_next.clone()
    others[:, leading(definition)] = math.nan
    others[:, index] = q_next[:, index]
    return saturated(definition, others)
