"""Systematic errors of a model that a session adds to its predictions.

Shapes: N lanes, C coordinates, F action entries, O outputs, P inputs of a residual (see ``inputs``).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.step_rules import paid, placed, settle, with_lags
from surrogym_server.errors import InvalidInput
from surrogym_server.models.port import DynamicsModel
from surrogym_server.tensors import constant, sent
from surrogym_server.virtual.dynamics import Moved
from surrogym_server.virtual.lanes import LaneState

FARTHEST = 3.0  # standardised inputs of a model's systematic error are clipped to this absolute value


@dataclass(frozen=True)
class Residual:
    """Systematic errors of a model: an affine function of standardised inputs for each output.

    There are K such sets of functions. Lane i (of N parallel environments) uses set i modulo K.
    """

    centre: tuple[float, ...]  # (P,) mean of each of the P inputs, which is subtracted to standardise the input
    scale: tuple[float, ...]  # (P,) standard deviation of each of the P inputs, by which the centred input is divided
    # (K, O, 1 + P) K sets of errors: for each of O outputs, a constant, and a factor for each of P standardised inputs.
    weights: tuple[tuple[tuple[float, ...], ...], ...]

    @classmethod
    def from_saved(cls, saved: Mapping[str, Any]) -> Self:
        """Build a residual from the JSON form in which a saved session contains it."""
        weights = tuple(tuple(map(tuple, rows)) for rows in saved["weights"])
        return cls(tuple(saved["centre"]), tuple(saved["scale"]), weights)

    def check(self, definition: EnvironmentDefinition) -> None:
        """Raise ``InvalidInput`` unless the residual has the numbers of inputs and outputs of the environment and its
        scales are above 0."""
        if definition.moves_observation:
            raise InvalidInput(
                "residual: expected a surrogate whose model predicts coordinates, got one of preset 'paper', which "
                "predicts observations: leave the residual out"
            )
        outputs = len(definition.outputs)
        size = len(definition.coordinates) + len(definition.angles) + definition.action.size
        shapes = {len(self.centre), len(self.scale), *(len(row) - 1 for rows in self.weights for row in rows)}
        if shapes != {size} or {len(rows) for rows in self.weights} != {outputs}:
            raise InvalidInput(
                f"residual: expected centre and scale with {size} numbers each, one for each coordinate and action "
                f"entry (two for an angle), and weights with {size + 1} numbers for each of {outputs} outputs; got "
                "arrays of other sizes: fit the residual to this surrogate"
            )
        if min(self.scale) <= 0:
            raise InvalidInput(f"residual: expected each number of scale to be above 0, got {min(self.scale)}")

    def of(self, definition: EnvironmentDefinition, lanes: LaneState, u: Tensor) -> Tensor:
        """Return the errors of all outputs, (N, O), in the step of N lanes under actions u (N, F)."""
        x, device = inputs(definition, lanes.q, u), definition.device
        x = ((x - constant(self.centre, device)) / constant(self.scale, device)).clamp(-FARTHEST, FARTHEST)
        x = torch.cat([torch.ones_like(x[:, :1]), x], 1)
        weights = constant(self.weights, device)
        return torch.einsum("nop,np->no", weights[sent(lanes.lane % len(weights), device)], x)


def inputs(definition: EnvironmentDefinition, q: Tensor, u: Tensor) -> Tensor:
    """Return the inputs of a residual, (N, P): coordinates q (N, C), with cosine and sine in place of an angle, and
    actions u (N, F)."""
    columns: list[Tensor] = []
    for index in range(q.shape[1]):
        value = q[:, index]
        columns += [value.cos(), value.sin()] if index in definition.angles else [value]
    return torch.cat([torch.stack(columns, 1), u.to(q.dtype)], 1)


def with_residual(model: DynamicsModel, residual: Residual, lanes: LaneState, u: Tensor, moved: Moved) -> Moved:
    """Return the predicted step ``moved`` of N lanes under actions u (N, F) with the errors of ``residual`` added.
    Then clip coordinates to their bounds, wrap angles and determine termination again."""
    definition = model.definition
    errors = residual.of(definition, lanes, u)
    q = settle(definition, moved.q + placed(definition, errors[:, :-1]))
    q = with_lags(definition, lanes.q, u, q)
    over = model.terminated(q)
    more = errors[:, -1] + paid(model.terminal_reward, torch.zeros_like(errors[:, -1]), over)
    more = more - paid(model.terminal_reward, torch.zeros_like(errors[:, -1]), moved.terminated)
    mean = moved.reward_mean + more
    reward = mean if moved.reward is moved.reward_mean else moved.reward + more
    return replace(moved, q=q, terminated=over, reward_mean=mean, reward=reward)
