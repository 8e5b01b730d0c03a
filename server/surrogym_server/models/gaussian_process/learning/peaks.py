"""Learning of a reward that is nearly zero almost everywhere, with a peak that few samples reach.

The logarithms of its values are learned instead, if they explain the samples better. A process of the values only sees
the few samples with a reward, and predicts a flat reward elsewhere.

For samples with a reward of exactly zero, the logarithm is below that of the others. Their targets are the predictions
of the process of the others, or the smallest of the others if that is smaller (regression imputation of censored
values). They influence the hyperparameters only if they contradict the process of the others.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace

import torch
from torch import Tensor

from surrogym_server.environment.definition import REWARD
from surrogym_server.environment.features import FeatureMap
from surrogym_server.gp import condition_many
from surrogym_server.models.gaussian_process.learning.output_learner import PEAK, OutputLearner
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel
from surrogym_server.models.gaussian_process.prediction.warp import Warp

FAINT = 0.1  # quantile of the rewards above the base whose height is compared with the greatest height
# A peak is considered if the greatest height and the FAINT quantile are this many decades apart. Squares in one
# dimension reach this spread at 6 %.
SPREAD = 3.0
DECADES = 10.0  # such a spread, in decades, is always a peak: neither noise nor rounding reaches it
REFITS = 3  # greatest number of further fits, each with samples that contradict the previous one
BELOW = 10.0  # if few samples have a reward, the logarithm of the others is assumed this many nats below theirs
FEWEST = 3  # least number of samples with a reward that can predict the others
EPS = 4 * torch.finfo(torch.float64).eps  # a reward within this share of the base equals the base
RESOLUTION = 1e-3  # resolution at which explanations of the samples are compared, as a share of the largest reward
GAIN = 3.0  # least log odds of a process of the logarithms over no structure, unless the spread alone decides


def hides(reward: Tensor) -> bool:
    """Return whether many of the rewards (n,) are nearly zero compared with the largest, or all are zero."""
    return bool((reward == 0).all()) or any(True for _ in _bases(reward))


def with_peak(
    learner: OutputLearner, reward: Tensor, inputs: Mapping[FeatureMap, Tensor], going: Tensor, plain: OutputModel
) -> OutputModel:
    """Learn the reward by its logarithm, and return the result if it explains the samples better than ``plain``.

    Args:
        reward: rewards (n,).
        inputs: features (n, d) of each candidate map.
        going: (n,) bool, the samples to learn from.
        plain: the output that was learned from the rewards themselves, returned if it explains them better.
    """
    accounts = [_account_of(learner, reward, inputs, going, *base) for base in _bases(reward[going])]
    better = [account for account, structure in accounts if _better(account, structure, plain, reward, inputs, going)]
    return max(better, key=lambda account: _agreement(account, reward, inputs, going), default=plain)


def _bases(reward: Tensor) -> Iterator[tuple[float, float]]:
    """Yield candidate bases and signs of a peak of rewards (n,): above or below 0, above or below the median reward."""
    middle = float(reward.median())
    for base in dict.fromkeys((0.0, middle)):
        for sign in (1.0, -1.0):
            height = _heights(reward, base, sign)
            if float(height.min()) >= 0 and (_spread(height) >= SPREAD or _trace(height, base)):
                yield base, sign


def _heights(reward: Tensor, base: float, sign: float) -> Tensor:
    """Return the heights of rewards (n,) above the base (below it for sign -1); 0 for a difference within rounding."""
    height = sign * (reward - base)
    return torch.where(height.abs() <= EPS * abs(base), 0.0, height)


def _trace(height: Tensor, base: float) -> bool:
    """Return whether heights (n,) are an isolated peak that is invisible in float32, in which trainers compute."""
    float32, highest = torch.finfo(torch.float32), float(height.max())
    return 0 < highest < max(float32.eps * abs(base), float32.tiny) and float(height.median()) == 0


def _spread(height: Tensor) -> float:
    """Return the decades between the greatest of the heights (n,) above 0 and their lowest decile; 0 for fewer than
    two."""
    heights = height[height > 0]
    if len(heights) < 2:
        return 0.0
    faint = heights.sort().values[math.ceil(FAINT * len(heights)) - 1]
    return math.log10(float(heights.max())) - math.log10(float(faint))


def _account_of(
    learner: OutputLearner,
    reward: Tensor,
    inputs: Mapping[FeatureMap, Tensor],
    going: Tensor,
    base: float,
    sign: float,
) -> tuple[OutputModel, float]:
    """Learn the logarithms of the rewards' heights above a base (below it for sign -1). Return the output, and its log
    odds against targets that don't depend on the inputs.

    The process is fitted to the samples with a reward, and to those without one that would contradict it. It is then
    conditioned on all samples of ``going``.
    """
    height = _heights(reward, base, sign)
    positive = going & (height > 0)
    nothing, few = going & ~positive, int(positive.sum()) < FEWEST
    least = float(height[positive].min().log()) - few * BELOW
    target = torch.where(positive, height.log(), least)
    rows = going if few else positive
    output = learner.output(PEAK, target, inputs, rows, rows)
    for _ in range(REFITS):
        against = nothing & ~rows & (output.mean(inputs[output.feature_map]) > least)
        if not bool(against.any()):
            break
        rows = rows | against
        output = learner.output(PEAK, target, inputs, rows, rows)
    structure = _structure(output)
    if output.posterior is not None and bool((going & ~rows).any()):
        x = inputs[output.feature_map]
        y = (torch.where(nothing, output.mean(x).clamp_max(least), target) - output.centre) / output.scale
        posterior = condition_many([output.posterior.hyper], x[going], y[going])
        output = replace(output, posterior=posterior, left_out=int((~going).sum()))
    size = max(float(reward[going].std(correction=0)), torch.finfo(torch.float64).tiny)
    return replace(output, name=REWARD, warp=Warp(base, sign, size)), structure


def _better(
    account: OutputModel,
    structure: float,
    plain: OutputModel,
    reward: Tensor,
    inputs: Mapping[FeatureMap, Tensor],
    going: Tensor,
) -> bool:
    """Return whether a process of the logarithms explains the samples better than ``plain``, a process of the values.

    ``structure`` is the log odds of the logarithms' process against no structure; the others are as in ``with_peak``.
    """
    if account.posterior is None:
        return False
    if plain.posterior is None:
        return True
    assert account.warp is not None
    height = _heights(reward[going], account.warp.base, account.warp.sign)
    if _trace(height, account.warp.base) or _spread(height) >= DECADES:
        return True
    return structure >= GAIN and _agreement(account, reward, inputs, going) >= _agreement(plain, reward, inputs, going)


def _structure(output: OutputModel) -> float:
    """Return the log odds of a fitted process against targets that don't depend on their inputs."""
    if output.posterior is None:
        return 0.0
    count = output.posterior.points
    return dict(output.scores)[str(output.feature_map)] + 0.5 * count * (1 + math.log(2 * math.pi))


def _agreement(output: OutputModel, reward: Tensor, inputs: Mapping[FeatureMap, Tensor], going: Tensor) -> float:
    """Return the log probability of all rewards, each predicted from the others and rounded to ``RESOLUTION`` of the
    largest."""
    posterior, warp = output.posterior, output.warp
    assert posterior is not None
    if posterior.sparse is None:
        mean, variance = posterior.leave_one_out()
    else:  # of thousands of points each hardly influences its own prediction, so none is left out
        mean, latent = posterior.mean_and_variance(inputs[output.feature_map][going])
        variance = latent + posterior.hyper.noise_variance
    centre, spread = output.centre + output.scale * mean, output.scale * variance.sqrt()
    rewards = reward[going]
    base = 0.0 if warp is None else warp.base
    width = RESOLUTION * float((rewards - base).abs().max())
    low, high = rewards - width, rewards + width
    if warp is not None:
        ends = [(warp.sign * (end - warp.base)).clamp_min(0).log() for end in (low, high)]
        low, high = ends if warp.sign > 0 else ends[::-1]
    share = torch.special.ndtr((high - centre) / spread) - torch.special.ndtr((low - centre) / spread)
    return float(share.clamp_min(1 / (len(rewards) + 2) ** 2).log().sum())
