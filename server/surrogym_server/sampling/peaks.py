"""Search for the highest reward of an environment that pays almost nowhere, by optimism about unknown rewards.

Such a reward is known well in nearly the whole range, where it is 0 and does not matter. So the uncertainty index does
not find the place that pays, which lies between the points of any set spread over the range. Instead the search climbs
from the best candidates to the highest optimistic score (``RewardPeaks.promise``). The place found is queried until its
reward is known to the reward's tolerance.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.points import Points
from surrogym_server.environment.samples import Samples
from surrogym_server.models.abilities import RewardPeaks, offers
from surrogym_server.models.port import DynamicsModel

CLIMBERS, TRIES, CLIMBS = 16, 16, 24  # numbers of climbing points, of random steps of each per iteration, of iterations
WIDEST = 0.25  # standard deviation of the first iteration's random steps, as a share of the sampling range
SHRINK = 0.75  # factor of the random steps' length from one iteration to the next
NOTHING = torch.finfo(torch.float32).tiny  # trainers compute in float32, in which a smaller reward counts as 0
UNMET = 0.1  # a predicted reward is clearly above all samples if it exceeds them by this share of the range of rewards
NEW = 0.01  # a point nearer to a sample than this share of the sampling range counts as queried


def highest(
    model: DynamicsModel, samples: Samples, points: Points, tolerance: float, rng: np.random.Generator
) -> Points | None:
    """Return the step at which the reward may be highest, found by climbing from m points.

    None if the highest reward is known to the tolerance, or if the environment pays in more than a small part of the
    range (see the module's docstring). While all samples have the reward 0, there is nothing to climb: the step is then
    the point farthest from all samples.
    """
    definition = model.definition
    points = points[~_over(definition, points.q)]
    if definition.declared_reward is not None or not len(points):
        return None
    able = offers(model, RewardPeaks)
    if able is not None and able.reward_hides:
        top = _climbed(definition, able, points, rng)
        unknown = _unknown(model, samples, top, tolerance)
        new = unknown & (_distance(definition, samples, top) > NEW)
        if bool(unknown[0]) and bool(new.any()):
            return top[new.nonzero()[0]]
    if float(samples.reward.abs().max()) >= NOTHING:
        return None
    return points[_distance(definition, samples, points).argmax()[None]]


def _least(samples: Samples) -> float:
    """Return the smallest difference of rewards that counts; a trainer's float32 can't distinguish smaller ones."""
    return max(NOTHING, torch.finfo(torch.float32).eps * float(samples.reward.abs().max()))


def _unknown(model: DynamicsModel, samples: Samples, points: Points, tolerance: float) -> Tensor:
    """Return whether the reward at each of m points deserves a query, (m,) bool.

    It does if it is not known to the tolerance, or if it is predicted to be clearly above the reward of every sample.
    While no sample has a reward that a trainer can distinguish from 0, every point does.
    """
    prediction = model.transition(points.q, points.u, reward_std=True)
    assert prediction.reward_std is not None
    low, best = float(samples.reward.min()), float(samples.reward.max())
    unmet = prediction.reward - best > UNMET * (prediction.reward - low)
    return (prediction.reward_std > tolerance) | unmet | (best - low < _least(samples))


def _climbed(definition: EnvironmentDefinition, able: RewardPeaks, points: Points, rng: np.random.Generator) -> Points:
    """Climb from the best of m points to points of a higher optimistic reward, and return these, the highest first.

    Each climber tries random steps, whose length decreases, and takes the best one.
    """
    low, high = _limits(definition)
    value = able.promise(points.q, points.u)
    best = value.topk(min(CLIMBERS, len(value))).indices
    at, value, size = torch.cat([points.q, points.u], -1)[best], value[best], points.q.shape[1]
    for climb in range(CLIMBS):
        steps = torch.from_numpy(rng.standard_normal((len(at), TRIES, at.shape[1])))
        trials = at[:, None] + WIDEST * SHRINK**climb * (high - low) * steps
        trials = _in_space(definition, trials.clamp(low, high).flatten(0, 1))
        values = able.promise(trials[:, :size], trials[:, size:])
        values = torch.where(_over(definition, trials[:, :size]), -torch.inf, values).reshape(len(at), TRIES)
        new_value, place = values.max(1)
        better = new_value > value
        neighbours = trials.reshape(len(at), TRIES, -1)[torch.arange(len(at)), place]
        at, value = torch.where(better[:, None], neighbours, at), torch.where(better, new_value, value)
    at = at[value.argsort(descending=True)]
    return Points(at[:, :size], at[:, size:])


def _over(definition: EnvironmentDefinition, q: Tensor) -> Tensor:
    """Return whether the declared termination holds at q (m, C), (m,) bool. A query there would teach nothing."""
    return q.new_zeros(len(q), dtype=torch.bool) if definition.learns_termination else definition.terminated(q)


def _in_space(definition: EnvironmentDefinition, points: Tensor) -> Tensor:
    """Round discrete actions in points (m, C + F) to whole numbers; other points are returned unchanged."""
    return (
        torch.cat([points[:, : len(definition.coordinates)], points[:, len(definition.coordinates) :].round()], 1)
        if definition.action.nvec
        else points
    )


def _limits(definition: EnvironmentDefinition) -> tuple[Tensor, Tensor]:
    """Return the lower and upper ends of the ranges of all coordinates and action entries, (C + F,) each."""
    action = definition.action
    ranges = [(c.sampling.low, c.sampling.high) for c in definition.coordinates]
    ranges += [(0.0, n - 1.0) for n in action.nvec] or list(zip(action.low, action.high, strict=True))
    low, high = torch.tensor(ranges, dtype=torch.float64).T
    return low, high


def _distance(definition: EnvironmentDefinition, samples: Samples, points: Points) -> Tensor:
    """Return the distance (m,) from each of m points to the nearest sample's state, in widths of the sampling range."""
    low, high = _limits(definition)
    width = (high - low)[: points.q.shape[1]].clamp_min(1e-12)
    return torch.cdist(points.q / width, samples.q / width).amin(1)
