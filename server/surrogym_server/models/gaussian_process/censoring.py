"""Samples that ended at a bound. Their increments are cut off there, so they say little about the dynamics."""

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
    """Return from which samples, ending at q_next (m, C), a transition output learns, (m,) bool. It does not learn from
    samples whose result a limit may have changed.

    Args:
        column: index of the transition output.
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
    """Return which samples, ending at q_next (n, C), reached a bound that may have changed the result of coordinate
    ``index``, (n,) bool: a bound of this coordinate, or a wall, which stops another coordinate.

    A limit of another coordinate that stops nothing, such as the pressure limit of a relief valve, does not count.
    """
    limits = [i for i in definition.moving if i != index and definition.coordinates[i].stops is None]
    others = q_next.clone()
    others[:, limits] = math.nan
    return saturated(definition, others)


def saturates(definition: EnvironmentDefinition, index: int, q_next: Tensor) -> Tensor:
    """Return which samples, ending at q_next (n, C), reached a bound of coordinate ``index``, or of any other
    coordinate except the leading ones, whose clipped next values the output can read, (n,) bool."""
    others = q_next.clone()
    others[:, leading(definition)] = math.nan
    others[:, index] = q_next[:, index]
    return saturated(definition, others)
