"""Learning of a reward that is nearly zero almost everywhere, with a peak that few samples reach.

The logarithms of the rewards are learned instead, if they explain the samples better. A process of the rewards
themselves learns only from the few samples with a reward, and predicts a flat reward elsewhere.

For samples with a reward of exactly zero, the logarithm is below those of all other samples. A process is fitted to the
other samples. Its prediction is the target of a sample with reward zero, but at most the smallest logarithm of the
others (regression imputation of censored values). Samples with reward zero influence the hyperparameters only if this
process predicts more than the smallest logarithm there.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace

import torch
from torch import Tensor

from surrogym_server.environment.features import FeatureMap
from surrogym_server.gp import condition_many
from surrogym_server.models.gaussian_process.learning.output_learner import PEAK, OutputLearner
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel
from surrogym_server.models.gaussian_process.prediction.warp import Warp
from surrogym_shared.spec import REWARD

# The height of a reward is its distance from the base, the reward far from the peak. The greatest height is compared
# with this quantile of the heights above 0.
FAINT = 0.1
# A peak is considered if the greatest height is this many decades (powers of ten) above the ``FAINT`` quantile. A
# quadratic reward of one input is no such peak: its 10 % quantile is two decades below the greatest height.
SPREAD = 3.0
# Heights that spread over this many decades are always a peak, because neither noise nor rounding gives such a spread.
DECADES = 10.0
REFITS = 3  # greatest number of further fits, each with samples of height 0 that contradict the previous fit
# If fewer than ``FEWEST`` samples have a height above 0, the logarithms of the other heights are assumed to be this
# much below the lowest logarithm of those samples.
BELOW = 10.0
FEWEST = 3
EPS = 4 * torch.finfo(torch.float64).eps  # a reward within this share of the base counts as equal to the base
# Explanations are compared by the probability of an interval around each reward, whose half width is this share of the
# largest distance of a reward from the base.
RESOLUTION = 1e-3
# A peak's process (a Gaussian process) learns logarithms of heights, that is of how far rewards are above the usual
# reward. It is used only if the log odds of this process, against targets that don't depend on the inputs, are at least
# this. Heights that spread over DECADES are used in any case.
GAIN = 3.0


def with_peak(
    learner: OutputLearner, reward: Tensor, inputs: Mapping[FeatureMap, Tensor], going: Tensor, plain: OutputModel
) -> OutputModel:
    """Learn the logarithm of the reward. Return the result if it explains the samples better than ``plain`` does,
    otherwise ``plain``.

    Args:
        learner: fitter of the model's outputs.
        reward: rewards (n,).
        inputs: features (n, d) of the samples for each candidate feature map (encoding of state and action).
        going: (n,) bool, the samples to learn from.
        plain: the output that was learned from the rewards themselves.
    """
    accounts = [_account_of(learner, reward, inputs, going, *base) for base in _bases(reward[going])]
    better = [account for account, structure in accounts if _better(account, structure, plain, reward, inputs, going)]
    return max(better, key=lambda account: _agreement(account, reward, inputs, going), default=plain)


def _bases(reward: Tensor) -> Iterator[tuple[float, float]]:
    """Yield candidates for a peak of the rewards (n,), as pairs of a base and a sign. The base, 0 or the median reward,
    is the reward far from the peak. The sign is 1 for a peak above the base, -1 for a peak below it."""
    middle = float(reward.median())
    for base in dict.fromkeys((0.0, middle)):
        for sign in (1.0, -1.0):
            height = _heights(reward, base, sign)
            if float(height.min()) >= 0 and (_spread(height) >= SPREAD or _trace(height, base)):
                yield base, sign


def _heights(reward: Tensor, base: float, sign: float) -> Tensor:
    """Return the heights of rewards (n,): how far they are above ``base``, or below it if ``sign`` is -1. A difference
    that may be a rounding error counts as 0."""
    height = sign * (reward - base)
    return torch.where(height.abs() <= EPS * abs(base), 0.0, height)


def _trace(height: Tensor, base: float) -> bool:
    """Return whether the heights (n,) of rewards above the reward ``base`` form an isolated peak that float32, in which
    trainers compute, can't represent."""
    float32, highest = torch.finfo(torch.float32), float(height.max())
    return 0 < highest < max(float32.eps * abs(base), float32.tiny) and float(height.median()) == 0


def _spread(height: Tensor) -> float:
    """Return the spread of the heights (n,) that are above 0: the number of decades (powers of ten) from their lowest
    decile to the greatest height. The result is 0 if fewer than two are above 0."""
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
    """Learn the logarithms of the heights of the rewards above ``base``, or below it if ``sign`` is -1. Return the
    output, and the log odds of its process against targets that don't depend on the inputs.

    The process is fitted to the samples whose height is above 0, and to samples of height 0 at which it would predict
    too much. Then it is conditioned on all samples ``going`` (n,).
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
    """Return whether ``account``, which learned the logarithms of the rewards, explains the samples better than
    ``plain``, which learned the rewards themselves.

    ``structure`` are the log odds of the process of ``account`` against targets that don't depend on the inputs. The
    samples have the rewards ``reward`` (n,) and the features ``inputs``; ``going`` (n,) is true for those that are
    compared.
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
    """Return the log odds of an output's process against targets that don't depend on the inputs."""
    if output.posterior is None:
        return 0.0
    count = output.posterior.points
    return dict(output.scores)[str(output.feature_map)] + 0.5 * count * (1 + math.log(2 * math.pi))


def _agreement(output: OutputModel, reward: Tensor, inputs: Mapping[FeatureMap, Tensor], going: Tensor) -> float:
    """Return the sum of the log probabilities of the rewards of the samples ``going`` (n,), each predicted from the
    others. Each is the probability of a narrow interval around the reward, see ``RESOLUTION``."""
    posterior, warp = output.posterior, output.warp
    assert posterior is not None
    if posterior.sparse is None:
        mean, variance = posterior.leave_one_out()
    else:
        # With inducing points there are many points; none needs to be left out, as each has little influence on its
        # prediction.
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
