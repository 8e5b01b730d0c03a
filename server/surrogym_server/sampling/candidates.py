"""Candidates for the next real steps: states and actions from the sampling range and from the states that policies
visited."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.points import Points
from surrogym_server.models.port import DynamicsModel
from surrogym_server.sampling.acquisition import acquisition_of
from surrogym_server.sampling.latin_hypercube import random_points
from surrogym_server.sampling.occupancy import log_occupancy

MAX_CANDIDATES = 4_096  # at most this many candidates come from the Monte Carlo set, and as many from visited states
REFERENCE = 256  # at most this many reference points come from the Monte Carlo set, and as many from visited states
# If policies have visited states, these have this share of the total weight of the reference points at which a query
# should reduce the variance. Reference points from the Monte Carlo set have the rest.
OCCUPIED = 0.75


@dataclass(frozen=True)
class Candidates:
    """Candidates for the next real steps (states and actions), their input probabilities, and the reference points at
    which these steps should reduce the model's variance."""

    points: Points  # the m candidates: states and actions
    log_p: Tensor  # (m,) logarithm of the input probability P_i (eq. 11); 0 if the acquisition does not use it
    reference: Points  # r states and actions at which the variance should become small
    weights: Tensor  # (r,) weight of each reference point in the mean variance; the weights add up to 1
    # (m,) bool, true for the candidates of which one becomes the first query, because they are near a termination, a
    # jump or a peak of the reward; None if there are none.
    reserved: Tensor | None = None


def candidates_of(model: DynamicsModel, points: Points, states: Tensor | None, rng: np.random.Generator) -> Candidates:
    """Build candidates for queries from the Monte Carlo set, m ``points`` spread over the sampling range, and from
    ``states`` (v, C) that policies visited, with random actions.

    Visited states are added because few points of the Monte Carlo set lie where a policy goes. Reference points are
    chosen from both sets too. Visited states outside the sampling range or within the margin of a limit are left out:
    if the model is wrong, a policy can reach states to which the real system must not be set.
    """
    definition = model.definition
    states = None if states is None else states[definition.in_range(states) & ~definition.falls_back(states, states)]
    points = points[:MAX_CANDIDATES]
    reference, weights = points[:REFERENCE], points.q.new_ones(min(len(points), REFERENCE))
    if states is not None and len(states) and model.definition.design.visited_candidates:
        visits = _visits(model.definition, states, len(points), rng)
        also = _visits(model.definition, states, REFERENCE, rng)
        weights = torch.cat(
            [weights * (1 - OCCUPIED) / len(weights), weights.new_full((REFERENCE,), OCCUPIED / REFERENCE)]
        )
        points, reference = Points.joined([points, visits]), Points.joined([reference, also])
    reads = acquisition_of(model.definition.design.acquisition).reads_probability
    log_p = input_probability(model, points, states) if reads else points.q.new_zeros(len(points))
    return Candidates(points, log_p, reference, weights / weights.sum())


def with_reserved(candidates: Candidates, points: Points) -> Candidates:
    """Add k ``points`` to the candidates and reserve only them: the first query of the round is one of them. They get
    the largest input probability of all candidates."""
    log_p = torch.cat([candidates.log_p, candidates.log_p.max().expand(len(points))])
    points_of_all = Points.joined([candidates.points, points])
    reserved = torch.arange(len(points_of_all)) >= len(candidates.points)
    return replace(candidates, points=points_of_all, log_p=log_p, reserved=reserved)


def input_probability(model: DynamicsModel, points: Points, states: Tensor | None) -> Tensor:
    """Return the logarithm of the input probability P_i (eq. 11) at m points, (m,), given visited states (v, C).

    It follows from the density of the visited states. Without visited states the logarithm is 0, or, if the
    definition's ``input_probability`` is "predicted", it follows from the density of the predicted next states.
    """
    definition = model.definition
    if states is not None and len(states):
        return log_occupancy(definition, states, points.q)
    if definition.design.input_probability == "predicted":
        arrived = model.transition(points.q, points.u).q_next
        return log_occupancy(definition, arrived, arrived, floor=1e-12)
    return points.q.new_zeros(len(points))


def under_random_actions(definition: EnvironmentDefinition, states: Tensor, rng: np.random.Generator) -> Points:
    """Return states (v, C), each with a random action from the action space."""
    return Points(states, random_points(definition, len(states), rng)[1])


def _visits(definition: EnvironmentDefinition, states: Tensor, count: int, rng: np.random.Generator) -> Points:
    rows = torch.from_numpy(rng.integers(len(states), size=count))
    return under_random_actions(definition, states[rows], rng)
