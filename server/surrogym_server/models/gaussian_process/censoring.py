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
    """Return which samples that end at q_next (m, C) a transition output learns from, (m,) bool.

    Args:
        column: the output.
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
    """Return which samples (n,) ended at a bound after which coordinate ``index`` is unknown: its own, or a wall.

    A limit of another coordinate, such as a relief valve's, does not make a sample useless.
    """
    limits = [i for i in definition.moving if i != index and definition.coordinates[i].stops is None]
    others = q_next.clone()
    others[:, limits] = math.nan
    return saturated(definition, others)


def saturates(definition: EnvironmentDefinition, index: int, q_next: Tensor) -> Tensor:
    """Return which samples (n,) ended with coordinate ``index``, or any other except the leading one, at a bound."""
    others = q_next.clone()
    others[:, leading(definition)] = math.nan
    others[:, index] = q_next[:, index]
    return saturated(definition, others)
