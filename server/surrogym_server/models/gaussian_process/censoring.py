"""Samples that ended at a bound: their increments were cut, and say little about the dynamics."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.features import FeatureMap, leading
from surrogym_server.environment.samples import saturated


def usable(definition: EnvironmentDefinition, column: int, q_next: Tensor, feature_map: FeatureMap) -> Tensor:
    """Which samples that end at q_next (m, C) the transition output ``column`` learns from under a map, (m,) bool."""
    if definition.moves_observation:
        return torch.ones(len(q_next), dtype=torch.bool)
    if feature_map.lead:
        return ~saturates(definition, definition.moving[column], q_next)
    return ~saturated(definition, q_next)


def saturates(definition: EnvironmentDefinition, index: int, q_next: Tensor) -> Tensor:
    """Samples (n,) in which anything but the lead ended at a bound, coordinate ``index`` included."""
    others = q_next.clone()
    others[:, leading(definition)] = math.nan
    others[:, index] = q_next[:, index]
    return saturated(definition, others)
