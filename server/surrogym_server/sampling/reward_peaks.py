"""Search for the highest reward of an environment whose reward is 0 almost everywhere, by an optimistic score.

The model knows such a reward well in nearly the whole range, where it is 0. So the uncertainty index does not find the
small region with a reward, which lies between the points of any set spread over the range. Instead the search climbs
from the best candidates to the highest optimistic score of the reward (``RewardPeaks.promise``). Real steps are
requested at the point found until its reward is known within the tolerance.
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
from surrogym_shared.spec import limits

# The search climbs from this many points, tries this many random steps from each in an iteration, and has this many
# iterations.
CLIMBERS, TRIES, CLIMBS = 16, 16, 24
WIDEST = 0.25  # standard deviation of the search's first random steps, as a share of the sampling range
SHRINK = 0.75  # factor by which the search's random steps become shorter from one iteration to the next
NOTHING = torch.finfo(torch.float32).tiny  # trainers compute in float32, in which a smaller reward counts as 0
# A predicted reward r is clearly above the rewards of all samples if r - highest > UNMET * (r - lowest), where highest
# and lowest are rewards of samples.
UNMET = 0.1
NEW = 0.01  # a point closer to a sample's state than this share of the sampling range needs no query


def highest(
    model: DynamicsModel, samples: Samples, points: Points, tolerance: float, rng: np.random.Generator
) -> Points | None:
    """Return the point (state and action) at which the reward may be highest, found by climbing from m ``points``; None
    if no query is needed.

    No query is needed if the highest reward is known within ``tolerance``, that of the reward, or if rewards are not
    nearly zero almost everywhere (see the module's docstring). As long as all samples have the reward 0, climbing is
    impossible; then the point is the one of ``points`` that is farthest from all samples.
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
    """Return the smallest difference of rewards that trainers can distinguish, because they compute in float32."""
    return max(NOTHING, torch.finfo(torch.float32).eps * float(samples.reward.abs().max()))


def _unknown(model: DynamicsModel, samples: Samples, points: Points, tolerance: float) -> Tensor:
    """Return for each of m points whether its reward is so uncertain that a real step is needed there, (m,) bool.

    A step is needed if the reward's standard deviation is above its ``tolerance``, or if its prediction is clearly
    above the rewards of all samples. It is needed at every point as long as the rewards of the samples differ too
    little for a trainer to distinguish them.
    """
    prediction = model.transition(points.q, points.u, reward_std=True)
    assert prediction.reward_std is not None
    low, best = float(samples.reward.min()), float(samples.reward.max())
    unmet = prediction.reward - best > UNMET * (prediction.reward - low)
    return (prediction.reward_std > tolerance) | unmet | (best - low < _least(samples))


def _climbed(definition: EnvironmentDefinition, able: RewardPeaks, points: Points, rng: np.random.Generator) -> Points:
    """Climb from the best of m points to points with a higher optimistic score of the reward (``RewardPeaks.promise``).
    Return the points that are reached, those with the highest score first.

    From each point, several random steps are tried in each iteration, and the best is taken if it increases the score.
    The length of the random steps decreases from one iteration to the next.
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
    """Return (m,) bool: whether the declared termination holds at states q (m, C); false if termination is learned. A
    real step from a terminated state would teach nothing."""
    return q.new_zeros(len(q), dtype=torch.bool) if definition.learns_termination else definition.terminated(q)


def _in_space(definition: EnvironmentDefinition, points: Tensor) -> Tensor:
    """Return points (m, C + F) with discrete actions rounded to whole numbers. Points with continuous actions are
    returned unchanged."""
    return (
        torch.cat([points[:, : len(definition.coordinates)], points[:, len(definition.coordinates) :].round()], 1)
        if definition.action.nvec
        else points
    )


def _limits(definition: EnvironmentDefinition) -> tuple[Tensor, Tensor]:
    """Return the lower and upper ends of the ranges of all coordinates and action entries, (C + F,) each."""
    ranges = [*(limits(c.sampling) for c in definition.coordinates), *definition.action.ranges]
    low, high = torch.tensor(ranges, dtype=torch.float64).T
    return low, high


def _distance(definition: EnvironmentDefinition, samples: Samples, points: Points) -> Tensor:
    """Return the distance (m,) from each of m points to the nearest sample's state, in widths of the sampling range."""
    low, high = _limits(definition)
    width = (high - low)[: points.q.shape[1]].clamp_min(1e-12)
    return torch.cdist(points.q / width, samples.q / width).amin(1)
