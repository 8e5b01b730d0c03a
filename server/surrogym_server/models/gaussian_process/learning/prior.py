"""Decide by left-out samples whether an output is learned as the difference from a prior model, or without it.

A prior model is another model of the same environment, for example of a simulator. An output that uses it is its mean
plus a process, the discrepancy of Kennedy and O'Hagan (2001), Journal of the Royal Statistical Society B 63(3).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor

from surrogym_server.environment.samples import Samples
from surrogym_server.gp import LeftOut
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel

# Differences from the prior model's mean up to this share of an output's standard deviation are rounding errors.
NOTHING = 1e-9
# An output is learned without the prior model if all left-out samples together are likelier by this log factor.
MARGIN = 3.0
BY_PRIOR = "with the prior, mean log density of a left-out sample"
# For a fit of the difference from a prior model, this is added to the output's name in the key of its warm start.
BESIDE = " beside prior"
Learn = Callable[[str, Tensor], OutputModel]  # function that fits an output, from its name and its targets (n,)
ALONE = "without the prior, mean log density of a left-out sample"


@dataclass(frozen=True)
class Known:
    """Predictions of a prior model at n samples."""

    change: Tensor  # (n, M) predicted value of each transition output
    # (n,) predicted reward, without the terminal reward; None if the prior model's reward never varied, because most
    # simulators know of no reward
    reward: Tensor | None
    terminal: float  # terminal reward of the prior model: what steps that end an episode give in addition

    @classmethod
    def of(cls, prior: GaussianProcessModel, samples: Samples) -> Self:
        """Compute the predictions of a prior model at the samples."""
        means = prior.means_before_end(samples.q, samples.u)
        varies = prior.reward.posterior is not None or bool(prior.jumps)
        return cls(means[:, :-1], means[:, -1] if varies else None, prior.terminal_reward)


def better_of(learn: Learn, name: str, target: Tensor, known: Tensor | None, keep: Tensor) -> OutputModel:
    """Learn an output from its targets (n,) with and without the prior model. Return the result with the prior model,
    unless ``contradicts`` says that left-out samples speak against it.

    Args:
        learn: function that fits an output.
        name: name of the output.
        target: targets (n,).
        known: mean that the prior model predicts at the samples, (n,), or None if there is no prior.
        keep: (n,) bool, the samples to learn from.
    """
    alone = learn(name, target)
    if known is None or alone.posterior is None:
        return alone
    found = beside(learn, name, target, known, keep)
    scores = (log_density(found), log_density(alone))
    noted = tuple((name, score) for name, score in zip((BY_PRIOR, ALONE), scores, strict=True) if math.isfinite(score))
    chosen = alone if contradicts(scores[0], scores[1], int(keep.sum())) else found
    return replace(chosen, scores=(*chosen.scores, *noted))


def contradicts(by_prior: float, alone: float, count: int) -> bool:
    """Return whether ``count`` left-out samples, whose mean log densities are ``by_prior`` and ``alone``, are clearly
    likelier without the prior model."""
    return count * (alone - by_prior) > MARGIN


def beside(learn: Learn, name: str, target: Tensor, known: Tensor, keep: Tensor) -> OutputModel:
    """Learn how targets (n,) differ from the mean ``known`` (n,) that the prior model predicts, from the samples
    ``keep`` (n,)."""
    left, size = target - known, float(target[keep].std(correction=0))
    is_rounding = float(left[keep].abs().max()) <= NOTHING * size
    output = learn(name + BESIDE, torch.zeros_like(left) if is_rounding else left)
    return replace(output, name=name, size_with_prior=size or 1.0)


def log_density(output: OutputModel) -> float:
    """Return the mean log density of a target that is predicted from all other samples, in the output's unit; infinite
    for an output without a process."""
    if (posterior := output.posterior) is None:
        return math.inf
    if posterior.sparse is not None:
        mean = posterior.left_out.log_density
    else:
        foretold, variance = posterior.leave_one_out()
        mean = LeftOut.of(foretold - posterior.y, variance).log_density
    return mean - float((output.scale * output.amplitude(posterior.x)).log().mean())
