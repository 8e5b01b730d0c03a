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

FAINT = 0.1  # share of the samples with a reward: the largest of these faint ones is compared with the best
SPREAD = 3.0  # decades between the two where a peak is looked for; squares in one dimension spread as far at 6 % ...
DECADES = 10.0  # ... and where nothing else spreads so far, neither noise nor rounding
REFITS = 3  # with samples that contradict the fit before
BELOW = 10.0  # nats: distance of the samples without a reward below the others, before they are predicted
FEWEST = 3  # samples with a reward that are needed to predict the others
EPS = 4 * torch.finfo(torch.float64).eps  # of the base: a value that is closer to it equals it
RESOLUTION = 1e-3  # of the largest: resolution at which explanations of the samples are compared
GAIN = 3.0  # nats by which structure in the logarithms must win where the spread leaves doubt


def hides(reward: Tensor) -> bool:
    """Whether many of the rewards (n,) are nearly zero compared with the largest, or all are zero."""
    return bool((reward == 0).all()) or any(True for _ in _bases(reward))


def with_peak(
    learner: OutputLearner, reward: Tensor, inputs: Mapping[FeatureMap, Tensor], going: Tensor, plain: OutputModel
) -> OutputModel:
    """The reward learned by its logarithm from the samples ``going`` (n,), if that explains them better; else
    ``plain``."""
    accounts = [_account_of(learner, reward, inputs, going, *base) for base in _bases(reward[going])]
    better = [account for account, structure in accounts if _better(account, structure, plain, reward, inputs, going)]
    return max(better, key=lambda account: _agreement(account, reward, inputs, going), default=plain)


def _bases(reward: Tensor) -> Iterator[tuple[float, float]]:
    """Candidate base and sign of peaks of rewards (n,): above or below 0, or above or below the median reward."""
    middle = float(reward.median())
    for base in dict.fromkeys((0.0, middle)):
        for sign in (1.0, -1.0):
            height = _heights(reward, base, sign)
            if float(height.min()) >= 0 and (_spread(height) >= SPREAD or _trace(height, base)):
                yield base, sign


def _heights(reward: Tensor, base: float, sign: float) -> Tensor:
    """Heights of rewards (n,) above their base; 0 if the difference is rounding."""
    height = sign * (reward - base)
    return torch.where(height.abs() <= EPS * abs(base), 0.0, height)


def _trace(height: Tensor, base: float) -> bool:
    """Whether heights (n,) show an isolated peak: above 0 in few places, and elsewhere too small for a trainer, which
    computes in float32."""
    float32, highest = torch.finfo(torch.float32), float(height.max())
    return 0 < highest < max(float32.eps * abs(base), float32.tiny) and float(height.median()) == 0


def _spread(height: Tensor) -> float:
    """Decades between the largest and the faint ones of the samples with a reward, of heights (n,)."""
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
    """A process of the logarithms, and the structure that it found in the samples that it was fitted to.

    It is fitted to the samples with a reward, and to those without one that would contradict it. It is conditioned on
    all.
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
    """Whether logarithms, with such ``structure`` in them, explain the samples better than their values do."""
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
    """Log odds of a fitted process against targets that don't depend on their inputs."""
    if output.posterior is None:
        return 0.0
    count = output.posterior.points
    return dict(output.scores)[str(output.feature_map)] + 0.5 * count * (1 + math.log(2 * math.pi))


def _agreement(output: OutputModel, reward: Tensor, inputs: Mapping[FeatureMap, Tensor], going: Tensor) -> float:
    """Log probability of every sample, predicted from all others, to ``RESOLUTION`` of the largest."""
    posterior, warp = output.posterior, output.warp
    assert posterior is not None
    if posterior.sparse is None:
        mean, variance = posterior.leave_one_out()
    else:  # one point of thousands hardly counts
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
