"""Inputs of the processes: encodings of coordinates and action, scaled so that each feature has deviation near 1.

An output's map is chosen by evidence among ``candidates``; nothing here knows a task.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product
from typing import Literal

import torch
from torch import Tensor

from surrogym_server.surrogate.definition import ActionDefinition, EnvironmentDefinition, wrap
from surrogym_server.surrogate.distributions import scaling


@dataclass(frozen=True)
class FeatureMap:
    """How (q, u) is shown to one output's process.

    ``state``: angles as cos and sin, as the wrapped angle, or both; or the observation, as the paper has it.
    ``action``: discrete actions as evenly spaced values, or one-hot. ``lead``: the predicted, clipped next value of
    saturating coordinates is an input as well, so that what follows from it (an angle from its speed) sees no kink.
    """

    state: Literal["cos_sin", "wrapped", "both", "observation"] = "cos_sin"
    action: Literal["value", "one_hot"] = "value"
    lead: bool = False

    def __str__(self) -> str:
        return ", ".join([self.state, f"action {self.action}", *(["lead"] if self.lead else [])])


def leading(definition: EnvironmentDefinition) -> tuple[int, ...]:
    """Coordinates that saturate on both sides without being a wall: limited speeds. They are predicted first."""
    return tuple(
        i
        for i in definition.moving
        if (c := definition.coordinates[i]).stops is None and math.isfinite(c.low) and math.isfinite(c.high)
    )


def candidates(definition: EnvironmentDefinition, follows: bool) -> tuple[FeatureMap, ...]:
    """Maps worth comparing for one output; ``follows`` says that it may read the lead."""
    if definition.design.preset == "paper":
        return (FeatureMap(state="observation"),)
    states: list[Literal["cos_sin", "wrapped", "both"]] = ["cos_sin"]
    if definition.angles:
        states += ["wrapped", "both"]
    actions: list[Literal["value", "one_hot"]] = ["value"]
    if any(n > 2 for n in definition.action.nvec):
        actions.append("one_hot")
    leads = [False, True] if follows and leading(definition) else [False]
    return tuple(FeatureMap(s, a, lead) for s, a, lead in product(states, actions, leads))


def encode(
    definition: EnvironmentDefinition, feature_map: FeatureMap, q: Tensor, u: Tensor, lead: Tensor | None = None
) -> Tensor:
    """Features of coordinates q (..., C), actions u (..., F) and, if the map reads it, the lead (..., L): (..., d)."""
    if feature_map.state == "observation":
        columns = list(definition.observe(q).unbind(-1))
    else:
        columns = _state_columns(definition, feature_map, q)
    columns += _action_columns(definition.action, feature_map, u)
    if feature_map.lead:
        assert lead is not None
        for column, index in enumerate(leading(definition)):
            centre, scale = scaling(definition.coordinates[index].sampling)
            columns.append((lead[..., column] - centre) / scale)
    return torch.stack(columns, -1)


def _state_columns(definition: EnvironmentDefinition, feature_map: FeatureMap, q: Tensor) -> list[Tensor]:
    columns = []
    for index, coordinate in enumerate(definition.coordinates):
        value = q[..., index]
        if coordinate.kind == "angle":
            if feature_map.state in ("cos_sin", "both"):
                columns += [value.cos(), value.sin()]
            if feature_map.state in ("wrapped", "both"):
                columns.append(wrap(value) * (math.sqrt(3) / math.pi))
        else:
            centre, scale = scaling(coordinate.sampling)
            columns.append((value - centre) / scale)
    return columns


def _action_columns(action: ActionDefinition, feature_map: FeatureMap, u: Tensor) -> list[Tensor]:
    columns = []
    if action.kind == "box":
        for entry, (low, high) in enumerate(zip(action.low, action.high, strict=True)):
            columns.append((u[..., entry] - (low + high) / 2) * (math.sqrt(12) / (high - low)))
        return columns
    for entry, count in enumerate(action.nvec):
        if feature_map.action == "one_hot" and count > 2:
            columns += [(u[..., entry] == value).to(u.dtype) for value in range(count)]
        else:
            columns.append((2 * u[..., entry] / (count - 1) - 1) * math.sqrt(3 * (count - 1) / (count + 1)))
    return columns
