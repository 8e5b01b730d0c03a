"""Prequential scores: each new sample is predicted by the last model before the next one learns from it.

References: A. P. Dawid (1984), Journal of the Royal Statistical Society A 147(2), for the principle; T. Gneiting, A. E.
Raftery (2007), Journal of the American Statistical Association 102(477), eq. 43, for the interval score.

Deviations are those of each process at the optimum of its hyperparameters, with the noise of a single step. Functions
with uncertain hyperparameters would take a second of every round.
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

LEVELS = (0.5, 0.8, 0.9)
KEPT = 20  # predictions of each output, the latest


@dataclass(frozen=True)
class Prediction:
    """One output of one sample, as a model predicted it before any model learned from the sample."""

    error: float  # sample less mean, in the output's unit
    deviation: float  # standard deviation, with the noise of a single step


Predictions = tuple[tuple[Prediction, ...], ...]  # of each output (O,), in order of arrival


@dataclass(frozen=True)
class PrequentialScores:
    """Scores of one output's last predictions. An error within the tolerance counts as inside every interval."""

    predictions: int
    within_50: float  # share of the samples in the central 50 % interval, or within the tolerance
    within_80: float
    within_90: float
    interval_score: float  # mean, of 90 % intervals that are at least as wide as the tolerance, over the tolerance


def scores_of(predictions: Sequence[Prediction], tolerance: float) -> PrequentialScores | None:
    """Score the predictions of one output; None if there are none."""
    if not predictions:
        return None
    error = torch.tensor([p.error for p in predictions], dtype=torch.float64)
    deviation = torch.tensor([p.deviation for p in predictions], dtype=torch.float64)
    half = [(half_width(level) * deviation).clamp_min(tolerance) for level in LEVELS]
    within_50, within_80, within_90 = (float((error.abs() <= one).double().mean()) for one in half)
    score = interval_score(-half[-1], half[-1], error, LEVELS[-1]) / tolerance
    return PrequentialScores(len(predictions), within_50, within_80, within_90, float(score.mean()))


def half_width(level: float) -> float:
    """Half the width of the central interval of a standard normal number that holds with ``level``."""
    return NormalDist().inv_cdf((1 + level) / 2)


def interval_score(low: Tensor, high: Tensor, value: Tensor, level: float) -> Tensor:
    """Score central prediction intervals from ``low`` to ``high`` at what happened, (m,) each (eq. 43). Lower is
    better."""
    missed = (low - value).clamp_min(0) + (value - high).clamp_min(0)
    return high - low + 2 / (1 - level) * missed


def predicted(model: DynamicsModel, samples: Samples) -> Predictions:
    """Predict samples that the model has not learned from.

    Changes that ended at a declared limit are left out, because the limit cuts them. So are rewards of steps that ended
    the episode, because they contain the terminal reward.
    """
    transition = model.transition(samples.q, samples.u, deviations=True, reward_deviation=True)
    assert transition.deviation is not None
    assert transition.reward_deviation is not None
    mean = torch.cat([model.means(samples.q, samples.u)[:, :-1], transition.reward[:, None]], -1)
    error = torch.cat([increments(model.definition, samples), samples.reward[:, None]], -1) - mean
    rewarded = torch.hypot(transition.reward_deviation, _reward_deviation_by_state(model, samples))
    deviation = torch.hypot(torch.cat([transition.deviation, rewarded[:, None]], -1), _noise(model, error))
    usable = error.isfinite() & deviation.isfinite()
    if not model.definition.moves_observation:
        usable[:, :-1] &= ~saturated(model.definition, samples.q_next)[:, None]
    usable[:, -1] &= ~samples.terminated
    return tuple(
        tuple(map(Prediction, error[rows, i].tolist(), deviation[rows, i].tolist())) for i, rows in enumerate(usable.T)
    )


def continued(before: Predictions, new: Predictions) -> Predictions:
    """The last ``KEPT`` predictions of each output."""
    return tuple((*old, *more)[-KEPT:] for old, more in zip(before or [()] * len(new), new, strict=True))


def pairs_of(predictions: Predictions) -> list[list[list[float]]]:
    """The predictions as JSON: [error, standard deviation] of each, by output."""
    return [[[p.error, p.deviation] for p in output] for output in predictions]


def from_pairs(pairs: Sequence[Sequence[Sequence[float]]]) -> Predictions:
    """The predictions that ``pairs_of`` wrote."""
    return tuple(tuple(Prediction(*pair) for pair in output) for output in pairs)


def _noise(model: DynamicsModel, like: Tensor) -> Tensor:
    """Standard deviation of the noise of a single step that the model has learned, (O,)."""
    able = offers(model, LearnedNoise)
    return like.new_zeros(like.shape[1]) if able is None else like.new_tensor(able.noise_deviations)


def _reward_deviation_by_state(model: DynamicsModel, samples: Samples) -> Tensor:
    """Standard deviation (m,) of the reward that the uncertain next state causes: 0 unless the reward depends on it.

    To first order: the reward's change when one output after the other moves by one standard deviation.
    """
    count, outputs = len(samples), len(model.definition.outputs) - 1
    one = torch.eye(outputs, dtype=samples.q.dtype).repeat_interleave(count, 0)
    q, u = samples.q.repeat(outputs, 1), samples.u.repeat(outputs, 1)
    up, down = (model.transition(q, u, noise=sign * one).reward.reshape(outputs, count) for sign in (1.0, -1.0))
    return ((up - down) / 2).square().sum(0).sqrt()
