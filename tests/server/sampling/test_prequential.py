"""Scores of predictions of new samples agree with quantile losses and a closed form, and leave out what they should."""

import numpy as np
import pytest
import torch
from scipy.stats import norm

from support.models import learn
from support.real_steps import random_steps
from surrogym_sampler.original.swingup import swing_up
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.samples import Samples, increments, saturated
from surrogym_server.sampling.prequential import (
    LATEST,
    Prediction,
    interval_score,
    latest,
    predicted,
    scores_of,
)
from surrogym_server.sampling.state import DesignState
from surrogym_shared.spec import DeclaredReward, Quantity, RewardTerm, Term


def test_the_interval_score_is_the_sum_of_two_quantile_losses():
    """J. Bracher et al. (2021), PLOS Computational Biology 17(2), eq. 1: 2 / alpha times the losses of both ends."""
    rng = np.random.default_rng(0)
    low, value = rng.normal(size=200), 3 * rng.normal(size=200)
    high = low + rng.exponential(size=200)

    def loss(end: np.ndarray, level: float) -> np.ndarray:
        return np.where(value >= end, level, level - 1) * (value - end)

    for level in (0.5, 0.8, 0.9):
        alpha = 1 - level
        expected = 2 / alpha * (loss(low, alpha / 2) + loss(high, 1 - alpha / 2))
        scored = interval_score(*map(torch.from_numpy, (low, high, value)), level)
        np.testing.assert_allclose(scored.numpy(), expected, rtol=1e-12)


def test_correct_deviations_give_nominal_coverage_and_the_lowest_interval_score():
    """With sigma = 1 the expected score of the central 90 % interval is 4 / alpha phi(z)."""
    errors = np.random.default_rng(1).normal(size=40_000).tolist()
    right, narrow, wide = (scores_of([Prediction(e, d) for e in errors], 1e-9) for d in (1.0, 0.5, 2.0))
    assert right is not None
    assert narrow is not None
    assert wide is not None
    assert (right.within_50, right.within_80, right.within_90) == pytest.approx((0.5, 0.8, 0.9), abs=0.01)
    assert right.interval_score * 1e-9 == pytest.approx(40 * norm.pdf(norm.ppf(0.95)), rel=0.02)
    assert right.interval_score < min(narrow.interval_score, wide.interval_score)
    assert narrow.within_90 < right.within_90 < wide.within_90


def test_a_prediction_error_within_the_tolerance_counts_as_covered():
    scores = scores_of([Prediction(0.09, 0.0), Prediction(-0.1, 1e-6)], 0.1)
    assert scores is not None
    assert (scores.within_50, scores.within_80, scores.within_90) == (1, 1, 1)
    assert scores.interval_score == pytest.approx(2)
    missed = scores_of([Prediction(0.2, 0.0)], 0.1)
    assert missed is not None
    assert (missed.within_90, missed.interval_score) == (0, pytest.approx(2 + 20))


def test_without_predictions_there_are_no_prequential_scores():
    assert scores_of([], 0.1) is None


def test_predictions_of_new_samples_use_model_deviation_plus_noise(model, unseen):
    free = unseen.at(~saturated(model.definition, unseen.q_next))
    made = predicted(model, free)
    errors = torch.tensor([[p.error for p in output] for output in made], dtype=torch.float64).T
    truth = torch.cat([increments(model.definition, free), free.reward[:, None]], -1)
    torch.testing.assert_close(errors, truth - model.means(free.q, free.u))
    latent = model.transition(free.q, free.u, stds=True).std
    assert latent is not None
    expected = torch.hypot(latent, latent.new_tensor(model.noise_stds[:-1]))
    found = torch.tensor([[p.std for p in output] for output in made[:-1]], dtype=torch.float64)
    torch.testing.assert_close(found.T, expected)


def test_neither_clipped_increments_nor_rewards_of_steps_that_end_an_episode_are_scored(model, unseen):
    cut = saturated(model.definition, unseen.q_next)
    assert 0 < int(cut.sum()) < len(unseen)
    ended = Samples(unseen.q, unseen.u, unseen.q_next, unseen.reward, torch.arange(len(unseen)) < 7)
    counts = [len(output) for output in predicted(model, ended)]
    assert counts == [int((~cut).sum())] * 2 + [len(unseen) - 7]


def test_the_reward_deviation_includes_the_uncertainty_of_the_next_state():
    """Against draws of the next state, for a declared reward that reads it, which is exact otherwise."""
    term = RewardTerm(shape="square", of=(Quantity(term=Term.linear(omega=1)),))
    reward = DeclaredReward(kind="declared", timing="after", terms=(term,))
    definition = definition_from_spec(swing_up().model_copy(update={"reward": reward}))
    model = learn(definition, random_steps(swing_up(), 20, seed=3)).model
    fresh = random_steps(swing_up(), 20, seed=4)
    noise = torch.randn(1_000, 20, len(definition.outputs) - 1, generator=torch.Generator().manual_seed(5))
    drawn = torch.stack([model.transition(fresh.q, fresh.u, noise=one.double()).reward for one in noise]).std(0)
    found = np.array([p.std for p in predicted(model, fresh)[-1]])
    np.testing.assert_allclose(np.median(found / drawn.numpy()), 1, atol=0.05)


def test_only_the_latest_predictions_are_kept_and_survive_json():
    old = (tuple(Prediction(float(i), 1.0) for i in range(LATEST)), ())
    new = ((Prediction(-1.0, 2.0),), (Prediction(0.5, 0.25),))
    kept = latest(old, new)
    assert [len(output) for output in kept] == [LATEST, 1]
    assert kept[0][0].error == 1.0
    assert kept[0][-1] == Prediction(-1.0, 2.0)
    assert latest((), new) == new
    state = DesignState(predictions=kept)
    assert DesignState.from_json(state.to_json()) == state
    assert DesignState.from_json({}).predictions == ()
