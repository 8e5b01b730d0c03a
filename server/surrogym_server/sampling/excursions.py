"""Excursions: action sequences that test a model where there are no samples.

If real steps begin at resets or snapshots, the first ones cover a small part of the sampling range. A model that fits
this part can be sure of the rest and wrong there: near an inflection point every function looks linear. So before a
design with snapshots is ready, one sequence leads away from all samples.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np
import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.features import distances
from surrogym_server.environment.points import Points
from surrogym_server.models.port import DynamicsModel
from surrogym_server.sampling.rollouts import Sequences, best_rollout, predict_paths
from surrogym_shared.nouns import Query, Vector

# An excursion, an action sequence that tests the model away from the samples, should end at least this far from the
# states of all samples, in standard deviations of the sampling range.
FAR = 0.5
LONGEST = 16  # greatest number of actions of an excursion (an action sequence that tests the model)


def excursion(
    model: DynamicsModel, samples: Tensor, snapshots: Mapping[str, Vector], longest: int, rng: np.random.Generator
) -> Query:
    """Plan an excursion: the shortest sequence of actions after which the predicted state is at least ``FAR`` (0.5)
    standard deviations of the sampling range away from the states of all samples.

    If no sequence leads so far, plan the one that leads farthest. States outside the sampling range don't count.

    Args:
        model: the model.
        samples: states (n, C) of all samples.
        snapshots: coordinates (C,) of each snapshot by name. The sequence begins at one of these or at a reset.
        longest: greatest number of actions.
        rng: source of random sequences.
    """
    longest = min(longest, LONGEST, model.definition.max_rollout or 1)
    return best_rollout(model.definition, partial(_reach, model, samples), longest, snapshots, rng)


def _reach(model: DynamicsModel, samples: Tensor, starts: Tensor, sequences: Sequences) -> tuple[Tensor, Tensor]:
    """Rate sequences of actions by how far they lead away from the samples.

    A sequence that reaches the distance ``FAR`` (0.5 standard deviations of the sampling range) has a higher value than
    any that does not, and a higher value than one that takes more actions to reach it.

    Args:
        model: the model.
        samples: states (n, C) of all samples.
        starts: s equally likely first states for each of k sequences, (k, s, C).
        sequences: k sequences of T actions, (k, T, F).

    Returns:
        Value of each sequence (k,), and the number of actions (k,) after which it is reached.
    """
    count, lanes = starts.shape[:2]
    paths = predict_paths(model, starts.flatten(0, 1), torch.from_numpy(sequences).repeat_interleave(lanes, 0))
    states = paths.q_next.flatten(0, 1)
    away = _state_distances(model.definition, states, samples).amin(1) * model.definition.in_range(states)
    away = (away.reshape(paths.running.shape) * paths.running).reshape(count, lanes, -1).mean(1)
    farthest = away.max(1)
    reached = away >= FAR
    first = reached.double().argmax(1)  # index of the first step that reaches FAR: argmax returns the first maximum
    value = torch.where(reached.any(1), FAR + away.shape[1] - first, farthest.values)
    return value, torch.where(reached.any(1), first, farthest.indices) + 1


def _state_distances(definition: EnvironmentDefinition, a: Tensor, b: Tensor) -> Tensor:
    """Return the distances (m, n) of states a (m, C) from states b (n, C), in standard deviations of the sampling
    range."""
    still = (Points(q, q.new_zeros(len(q), definition.action.size)) for q in (a, b))
    return distances(definition, *still)
