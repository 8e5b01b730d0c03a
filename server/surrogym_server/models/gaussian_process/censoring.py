"""Samples that ended at a bound. Their increments are cut, so they say little about the dynamics."""

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
    """Which samples that end at q_next (m, C) the transition output ``column`` learns from with a map, (m,) bool.

    ``past_limits`` means that it also learns from those that end at a limit of another coordinate.
    """
    if definition.moves_observation:
        return torch.ones(len(q_next), dtype=torch.bool)
    if past_limits:
        return ~stopped(definition, definition.moving[column], q_next)
    if feature_map.lead:
        return ~saturates(definition, definition.moving[column], q_next)
    return ~saturated(definition, q_next)


def stopped(definition: EnvironmentDefinition, index: int, q_next: Tensor) -> Tensor:
    """Samples (n,) that ended at a bound after which coordinate ``index`` is unknown: its own bound, or a wall. The
    limit of another coordinate, such as a relief valve's, does not make a sample useless."""
    limits = [i for i in definition.moving if i != index and definition.coordinates[i].stops is None]
    others = q_next.clone()
    others[:, limits] = math.nan
    return saturated(definition, others)


def saturates(definition: EnvironmentDefinition, index: int, q_next: Tensor) -> Tensor:
    """Samples (n,) in which a coordinate other than the lead ended at a bound, coordinate ``index`` included."""
    others = q_next.clone()
    others[:, leading(definition)] = math.nan
    others[:, index] = q_next[:, index]
    return saturated(definition, others)
