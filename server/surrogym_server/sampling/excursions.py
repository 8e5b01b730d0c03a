"""Excursions: action sequences that test a model where no sample has been.

A design that begins at resets or snapshots sees a small part of the sampling range at first. A model that fits this
part can be sure of all the rest and wrong there: beside an inflection every function looks linear. So before such a
design is ready, one sequence leads away from all samples.
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

FAR = 0.5  # least distance from an excursion's end to all samples, in standard deviations of the sampling range
LONGEST = 16  # greatest number of actions of an excursion


def excursion(
    model: DynamicsModel, samples: Tensor, snapshots: Mapping[str, Vector], longest: int, rng: np.random.Generator
) -> Query:
    """Plan the shortest sequence whose predicted state gets at least the distance ``FAR`` away from all samples.

    If no sequence gets so far, plan the one that leads farthest.

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

    A sequence that gets ``FAR`` away is rated above all that don't, and above longer ones.

    Args:
        model: the model.
        samples: states (n, C) of all samples.
        starts: equally likely first states of each of k sequences, (k, s, C).
        sequences: actions (k, T, F).

    Returns:
        Value (k,) and best length (k,) of each sequence.
    """
    count, lanes = starts.shape[:2]
    paths = predict_paths(model, starts.flatten(0, 1), torch.from_numpy(sequences).repeat_interleave(lanes, 0))
    states = paths.q_next.flatten(0, 1)
    away = _state_distances(model.definition, states, samples).amin(1) * model.definition.in_range(states)
    away = (away.reshape(paths.running.shape) * paths.running).reshape(count, lanes, -1).mean(1)
    farthest = away.max(1)
    reached = away >= FAR
    first = reached.double().argmax(1)  # the first step that reaches FAR, because argmax returns the first of equals
    value = torch.where(reached.any(1), FAR + away.shape[1] - first, farthest.values)
    return value, torch.where(reached.any(1), first, farthest.indices) + 1


def _state_distances(definition: EnvironmentDefinition, a: Tensor, b: Tensor) -> Tensor:
    """Return the distances of states a (m, C) and b (n, C), in standard deviations of the sampling range, (m, n)."""
    still = (Points(q, q.new_zeros(len(q), definition.action.size)) for q in (a, b))
    return distances(definition, *still)
