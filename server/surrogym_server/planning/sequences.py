"""Action sequences of policies on a coarse grid of states, as candidates for the rollouts of a design.

Random sequences hardly ever lead where a policy goes, for example to a goal at the end of a long way.

Shapes: s starts, C coordinates, T steps, F action entries.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.models.abilities import CompiledSteps, GridPolicy, offers
from surrogym_server.models.port import DynamicsModel
from surrogym_server.planning.grid import GridModel, at_nearest_node, discount_of, unfit
from surrogym_server.planning.pending import PendingActions

Floats = NDArray[np.float64]

NODES = 20_000  # largest number of nodes of the coarse grid
SEEKING = 0.995  # discount of the policy that seeks the end of the episode


def policy_sequences(model: DynamicsModel, starts: Tensor, length: int, *, seek_end: bool) -> Floats | None:
    """Return the actions of policies along their mean paths from the starts (s, C), as sequences (k, T, F) of
    ``length`` steps. The model's mean defines the policies.

    One policy earns the highest return. With ``seek_end`` another one comes first, which reaches a termination as soon
    as possible. Return None if the model has no compiled steps, or the environment more coordinates or actions than a
    grid allows.
    """
    definition, compiled = model.definition, offers(model, CompiledSteps)
    steps = None if compiled is None or unfit(definition) is not None else compiled.compiled()
    if steps is None:
        return None
    pending = PendingActions.of(steps)
    on_grid = GridModel.of(pending, model.terminal_reward, NODES)
    policies = [on_grid.policy(discount_of(definition.time_limit))]
    if seek_end:
        ends = np.isnan(on_grid.q_next[:, :, 0]).astype(np.float32)
        policies.insert(0, on_grid.policy(SEEKING, ends))
    return np.concatenate([_actions(model, pending, policy, starts, length) for policy in policies])


def _actions(model: DynamicsModel, pending: PendingActions, policy: GridPolicy, q: Tensor, length: int) -> Floats:
    """Return the actions (s, T, F) of a policy along the mean paths from q (s, C). They go on after a termination."""
    taken = []
    for _ in range(length):
        u = at_nearest_node(policy, pending.seen(q.numpy()))
        taken.append(u)
        q = _bounded(model.definition, model.transition(q, torch.from_numpy(u)).q_next)
    return np.stack(taken, 1)


def _bounded(definition: EnvironmentDefinition, q: Tensor) -> Tensor:
    """Return the states q (s, C), moved to at most one width of the sampling range outside of it, because a path may
    diverge there."""
    low, high = definition.sampled
    return q.nan_to_num().clamp(2 * low - high, 2 * high - low)
