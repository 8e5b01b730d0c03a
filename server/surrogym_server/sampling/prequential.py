"""Prequential scores: how well each new sample is predicted by the latest model before the next model learns from it.

References: A. P. Dawid (1984), Journal of the Royal Statistical Society A 147(2), for the principle; T. Gneiting, A. E.
Raftery (2007), Journal of the American Statistical Association 102(477), eq. 43, for the interval score.

Predictive standard deviations include the noise of a single step. Hyperparameters are fixed at their optimum, because
averaging over their posterior would take a second more in every round.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

import torch
from torch import Tensor

from surrogym_server.environment.samples import Samples, increments, saturated
from surrogym_server.models.abilities import LearnedNoise, offers
from surrogym_server.models.port import DynamicsModel

LEVELS = (0.5, 0.8, 0.9)  # probabilities of the central prediction intervals that are scored
LATEST = 20  # greatest number of predictions that are kept for each output


@dataclass(frozen=True)
class Prediction:
    """Prediction of one output of a sample, by a model that had not learned from the sample."""

    error: float  # value in the sample less predicted mean, in the output's unit
    std: float  # standard deviation of the prediction, including the noise of a single step


Predictions = tuple[tuple[Prediction, ...], ...]  # the predictions of each output (O,), the oldest first


@dataclass(frozen=True)
class PrequentialScores:
    """Scores of predictions of one output. Each sample was predicted before the model learned from it.

    A prediction whose error is within the tolerance counts as inside every prediction interval.
    """

    predictions: int
    within_50: float  # share of the samples that lie in the central 50 % prediction interval or within the tolerance
    within_80: float  # share of the samples that lie in the central 80 % prediction interval or within the tolerance
    within_90: float  # share of the samples that lie in the central 90 % prediction interval or within the tolerance
    # Mean interval score of the 90 % prediction intervals, divided by the tolerance. Intervals that reach less far than
    # the tolerance from their centre are widened to it.
    interval_score: float


def scores_of(predictions: Sequence[Prediction], tolerance: float) -> PrequentialScores | None:
    """Return the scores of one output's predictions, given its tolerance; None if there are no predictions."""
    if not predictions:
        return None
    error = torch.tensor([p.error for p in predictions], dtype=torch.float64)
    std = torch.tensor([p.std for p in predictions], dtype=torch.float64)
    half = [(half_width(level) * std).clamp_min(tolerance) for level in LEVELS]
    within_50, within_80, within_90 = (float((error.abs() <= one).double().mean()) for one in half)
    score = interval_score(-half[-1], half[-1], error, LEVELS[-1]) / tolerance
    return PrequentialScores(len(predictions), within_50, within_80, within_90, float(score.mean()))


def half_width(level: float) -> float:
    """Return half the width of the interval around 0 in which a standard normal number lies with probability
    ``level``."""
    return NormalDist().inv_cdf((1 + level) / 2)


def interval_score(low: Tensor, high: Tensor, value: Tensor, level: float) -> Tensor:
    """Return the interval scores (m,), eq. 43 of Gneiting and Raftery, of central prediction intervals from ``low``
    (m,) to ``high`` (m,) with probability ``level``, for the true values ``value`` (m,). Lower is better."""
    missed = (low - value).clamp_min(0) + (value - high).clamp_min(0)
    return high - low + 2 / (1 - level) * missed


def predicted(model: DynamicsModel, samples: Samples) -> Predictions:
    """Return the predictions of samples that the model has not learned from, for each output.

    Outputs of steps that ended at a declared limit are left out, because the limit cuts the change off. Rewards of
    steps that ended the episode are left out, because they contain the terminal reward.
    """
    transition = model.transition(samples.q, samples.u, stds=True, reward_std=True)
    assert transition.std is not None
    assert transition.reward_std is not None
    mean = torch.cat([model.means(samples.q, samples.u)[:, :-1], transition.reward[:, None]], -1)
    error = torch.cat([increments(model.definition, samples), samples.reward[:, None]], -1) - mean
    reward_std = torch.hypot(transition.reward_std, _reward_std_by_state(model, samples))
    std = torch.hypot(torch.cat([transition.std, reward_std[:, None]], -1), _noise(model, error))
    usable = error.isfinite() & std.isfinite()
    if not model.definition.moves_observation:
        usable[:, :-1] &= ~saturated(model.definition, samples.q_next)[:, None]
    usable[:, -1] &= ~samples.terminated
    return tuple(
        tuple(map(Prediction, error[rows, i].tolist(), std[rows, i].tolist())) for i, rows in enumerate(usable.T)
    )


def latest(before: Predictions, new: Predictions) -> Predictions:
    """Append the new predictions of each output to the earlier ones, and return the last ``LATEST`` (20) of each."""
    return tuple((*old, *more)[-LATEST:] for old, more in zip(before or [()] * len(new), new, strict=True))


def pairs_of(predictions: Predictions) -> list[list[list[float]]]:
    """Convert predictions to JSON: for each output a list of pairs [error, standard deviation]."""
    return [[[p.error, p.std] for p in output] for output in predictions]


def from_pairs(pairs: Sequence[Sequence[Sequence[float]]]) -> Predictions:
    """Convert the JSON that ``pairs_of`` returns back to predictions."""
    return tuple(tuple(Prediction(*pair) for pair in output) for output in pairs)


def _noise(model: DynamicsModel, like: Tensor) -> Tensor:
    """Return the standard deviation of a single step's noise that the model has learned, (O,); 0 if it learns none.
    ``like`` is a tensor (n, O) that gives the number of outputs."""
    able = offers(model, LearnedNoise)
    return like.new_zeros(like.shape[1]) if able is None else like.new_tensor(able.noise_stds)


def _reward_std_by_state(model: DynamicsModel, samples: Samples) -> Tensor:
    """Return the standard deviation (m,) of the reward that is due to the uncertain next state; 0 if the reward does
    not depend on the next state.

    It is computed to first order: the root of the sum of the squared changes of the reward, where each transition
    output in turn changes by one standard deviation.
    """
    count, outputs = len(samples), len(model.definition.outputs) - 1
    one = torch.eye(outputs, dtype=samples.q.dtype).repeat_interleave(count, 0)
    q, u = samples.q.repeat(outputs, 1), samples.u.repeat(outputs, 1)
    up, down = (model.transition(q, u, noise=sign * one).reward.reshape(outputs, count) for sign in (1.0, -1.0))
    return ((up - down) / 2).square().sum(0).sqrt()
