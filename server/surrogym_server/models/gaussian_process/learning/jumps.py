"""Search for jumps of a reward: regions of states inside which the reward is higher or lower by a constant.

Two explanations of the rewards are compared by their densities: one process of all rewards, by its evidence; and a
region with a jump, by the product of the evidence of a process outside the region, the density of the rewards inside
given one unknown jump, and the probability of the labels (which samples are inside).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace

import torch
from torch import Tensor

from surrogym_server.environment.features import FeatureMap
from surrogym_server.environment.samples import Samples
from surrogym_server.models.gaussian_process.learning.output_learner import CONSTANT, OutputLearner
from surrogym_server.models.gaussian_process.learning.region import learn_region
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel
from surrogym_server.models.gaussian_process.prediction.regions import Jump, Region
from surrogym_shared.spec import REWARD

EDGE = "reward edge"
MAX_JUMPS = 3
SPLITS = 3  # a jump of the reward is searched for at this many gaps between the sorted rewards, the widest first
GAP = 0.2  # a jump of the reward is searched for only at gaps wider than this share of the range of the rewards
# Log odds per sample by which jumps of the reward must be likelier than a reward without jumps. In experiments smooth
# bumps reached 1.5, true jumps at least 2.9.
MARGIN = 2.0
WORTH = 5.0  # log odds by which one more jump of the reward must be likelier than fewer jumps
SIZE = 3.0  # prior standard deviation of the height of a jump of the reward, in standard deviations of the reward
FLOOR = 1e-4  # standard deviation of the noise that every reward is taken to have, in standard deviations of the reward

Split = tuple[float, Region, OutputModel, Tensor]


def with_jumps(
    learner: OutputLearner, samples: Samples, inputs: Mapping[FeatureMap, Tensor], going: Tensor, plain: OutputModel
) -> tuple[OutputModel, tuple[Jump, ...]]:
    """Search for jumps: regions of states inside which the reward is higher or lower by a constant. Return the output
    for the reward without these constants, and the jumps. If jumps don't explain the rewards clearly better, return
    ``plain`` and no jumps.

    Args:
        samples: all n samples.
        inputs: features (n, d) of the samples for each candidate feature map (encoding of state and action).
        going: (n,) bool, the samples from which the reward is learned: the non-terminating steps.
        plain: the output that was learned from these samples without jumps.
    """
    best, process, total, rest = (0.0, plain, 0), plain, 0.0, going
    regions: list[tuple[Region, Tensor]] = []
    while process.posterior is not None and len(regions) < MAX_JUMPS:
        splits = list(_splits(learner, samples, inputs, rest, process))
        if not splits:
            break
        gain, edge, process, outside = max(splits, key=lambda split: split[0])
        regions.append((edge, rest & ~outside))
        total, rest = total + gain, outside
        # Each number of jumps is compared with no jump, because the first of two jumps may gain little by itself.
        if total > max(MARGIN * int(going.sum()), best[0] + WORTH):
            best = (total, process, len(regions))
    _, process, count = best
    residual = samples.reward - process.mean(inputs[process.feature_map])
    return process, tuple(Jump(edge, float(residual[inside].mean())) for edge, inside in regions[:count])


def _splits(
    learner: OutputLearner, samples: Samples, inputs: Mapping[FeatureMap, Tensor], going: Tensor, plain: OutputModel
) -> Iterator[Split]:
    """Yield candidates for a jump. Each splits the samples ``going`` (n,) by a level of the reward: the smaller part
    lies inside a region, the rest outside. A candidate consists of its log odds against ``plain``, the output that was
    learned without jumps; the region; the output learned from the samples outside; and the mask of these samples (n,).

    A single sample inside counts as a jump only if the rewards of all others are equal. Otherwise it may also lie on a
    steep slope.
    """
    same = replace(plain.feature_map, after=False)
    inputs = {m: x for m, x in inputs.items() if replace(m, after=False) == same}
    for level in _levels(samples.reward[going]):
        above = samples.reward > level
        few = 2 * int((above & going).sum()) <= int(going.sum())
        inside = going & (above if few else ~above)
        outside = going & ~inside
        level_outside = float(samples.reward[outside].std(correction=0)) <= CONSTANT * plain.scale
        if int(outside.sum()) < 2 or (int(inside.sum()) < 2 and not level_outside):
            continue
        process = learner.output(REWARD, samples.reward, inputs, outside, outside)
        x = inputs[process.feature_map][inside]
        mean, std = process.mean_and_std(x)
        residual, spread = (samples.reward[inside] - mean) / plain.scale, std / plain.scale
        gain = _evidence(process, int(outside.sum()), plain.scale) + _paid_inside(residual, spread)
        gain -= _evidence(plain, int(going.sum()), plain.scale)
        if gain < 0:
            continue
        state = (samples.q_next if process.feature_map.after else samples.q)[going]
        edge = learn_region(learner, EDGE, state, inside[going])
        gain += max(score for _, score in edge.scores)
        yield gain, edge, process, outside


def _levels(reward: Tensor) -> list[float]:
    """Return the levels at which to split rewards (n,): the middles of the widest gaps in their sorted sequence."""
    ordered = reward.sort().values
    gaps = ordered.diff()
    wide = [int(i) for i in gaps.argsort(descending=True)[:SPLITS] if gaps[i] > GAP * (ordered[-1] - ordered[0])]
    return [float(ordered[i] + ordered[i + 1]) / 2 for i in wide]


def _evidence(process: OutputModel, points: int, unit: float) -> float:
    """Return the log density of the rewards to which an output was fitted, if rewards are divided by ``unit``.
    ``points`` is the number of these rewards."""
    if process.posterior is None:
        return -points * (math.log(FLOOR) + 0.5 * math.log(2 * math.pi))
    return dict(process.scores)[str(process.feature_map)] - points * math.log(process.scale / unit)


def _paid_inside(residual: Tensor, spread: Tensor) -> float:
    """Return the log density of the residuals (i,) of i samples inside a region, if each is the sum of one common jump
    with a normal prior and an individual normal error with standard deviation ``spread`` (i,)."""
    shared = SIZE**2 * torch.ones(len(residual), len(residual), dtype=residual.dtype)
    covariance = shared + torch.diag(spread.square() + FLOOR**2)
    factor = torch.linalg.cholesky(covariance)
    whitened = torch.linalg.solve_triangular(factor, residual[:, None], upper=False)
    normaliser = float(factor.diagonal().log().sum()) + 0.5 * len(residual) * math.log(2 * math.pi)
    return -0.5 * float(whitened.square().sum()) - normaliser
