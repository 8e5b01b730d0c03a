"""The joint test of errors: what all steps share is found, a right model is left alone at any number of steps."""

from __future__ import annotations

import numpy as np
import pytest

from surrogym_sampler.original.classic import pendulum
from surrogym_trainer.evaluation.audit import Consequence
from surrogym_trainer.evaluation.systematic import DEGREES, Inputs, Systematic, region, systematic
from surrogym_trainer.policies.evidence import Promise

PROMISE = Promise(median=180.0, low=170.0, high=190.0, functions=32, episodes=256)
OUTPUTS, INPUTS = 3, 4


def jointly(seed: int, steps: int, shift: float = 0.0, tilt: float = 0.0, scale: float = 1.0) -> Systematic:
    """Errors with a deviation of ``scale``, where the model claims 1. Those of the second output are also shifted by
    ``shift``, and by ``tilt`` times the first input."""
    rng = np.random.default_rng(seed)
    x = np.concatenate([np.ones((steps, 1)), rng.standard_normal((steps, INPUTS))], 1)
    errors = scale * rng.standard_normal((steps, OUTPUTS))
    errors[:, 1] += shift + tilt * x[:, 1]
    inputs = Inputs(np.zeros(INPUTS), np.ones(INPUTS))
    return systematic("abc", errors, np.full(errors.shape, 0.1), np.ones(OUTPUTS), inputs, x)


def test_a_correct_model_rarely_shows_a_systematic_error_at_any_number_of_steps():
    alarms = sum(max(jointly(seed, steps).evidence for steps in (8, 16, 40)) >= 20 for seed in range(60))
    assert alarms <= 3


@pytest.mark.parametrize("scale", [0.05, 3.0])
def test_independent_errors_of_any_size_are_not_taken_for_systematic(scale: float):
    """On a policy's way they may be much smaller than elsewhere. Larger ones are what other tests are for."""
    assert sum(jointly(seed, 16, scale=scale).evidence >= 20 for seed in range(60)) <= 3


def test_a_systematic_error_below_the_predicted_deviation_is_found_if_other_errors_are_small():
    assert all(jointly(seed, 8, shift=0.7, scale=0.1).evidence > 20 for seed in range(20))


@pytest.mark.parametrize(("shift", "tilt"), [(1.0, 0.0), (0.0, 1.5)], ids=["everywhere", "by an input"])
def test_an_error_shared_by_all_steps_is_found_within_forty_steps(shift: float, tilt: float):
    """Each error is within what the model claims, and all are of one sign, or follow one input."""
    found = [jointly(seed, 40, shift=shift, tilt=tilt) for seed in range(20)]
    assert sum(one.evidence >= 20 for one in found) >= 19
    assert all(int(np.argmax(one.chances)) == 1 for one in found if one.evidence >= 20)


def test_the_evidence_for_a_systematic_error_equals_the_explicit_likelihood_ratio():
    """Both are written out, with matrices of the size of the steps."""
    rng, steps = np.random.default_rng(0), 12
    x = np.concatenate([np.ones((steps, 1)), rng.standard_normal((steps, INPUTS))], 1)
    errors, deviation = 1.5 + 0.5 * rng.standard_normal((steps, 1)), rng.uniform(0.1, 2.0, (steps, 1))
    claimed, inputs = np.array([0.7]), Inputs(np.zeros(INPUTS), np.ones(INPUTS))
    [forms] = systematic("a", errors, deviation, claimed, inputs, x).forms
    e, kernel = errors[:, 0] / claimed, (np.eye(steps) + x @ x.T / (1 + INPUTS)) / 2
    right = np.eye(steps) + deviation * kernel * deviation.T / claimed**2

    def log_density(covariance: np.ndarray) -> float:
        squares = DEGREES + e @ np.linalg.solve(covariance, e)
        return -0.5 * ((DEGREES + steps) * np.log(squares) + np.linalg.slogdet(covariance)[1])

    for form in forms:
        wrong = right + x * form.variances @ x.T
        assert np.log(form.evidence) == pytest.approx(log_density(wrong) - log_density(right))
        expected = form.variances[:, None] * x.T @ np.linalg.solve(wrong, e) * claimed
        np.testing.assert_allclose(form.mean, expected, atol=1e-9)


def test_draws_of_a_systematic_error_have_its_mean_and_uncertainty():
    found = jointly(0, 40, shift=2.0)
    weights = found.draws(400, np.random.default_rng(0))
    assert weights.shape == (400, OUTPUTS, 1 + INPUTS)
    assert weights[:, 1, 0].mean() == pytest.approx(2.0, abs=0.4)
    assert 0.1 < weights[:, 1, 0].std() < 0.4, "one over the square root of the number of steps"
    assert (weights[:, [0, 2]] == 0).all(2).mean() > 0.8, "the others are right"
    assert found.expected()[1, 0] == pytest.approx(2.0, abs=0.4)
    assert not found.expected()[[0, 2]].any()


def test_every_random_draw_of_model_errors_is_nonzero_for_an_output_known_to_be_wrong():
    found, rng = jointly(0, 8, scale=3.0), np.random.default_rng(0)
    wrong = np.array([False, True, False])
    drawn = found.draws(400, rng, wrong)
    assert (drawn[:, 1] != 0).any(1).all()
    assert (drawn[:, [0, 2]] == 0).all(2).mean() > 0.5


def consequence(seed: int, shift: float, cost: float, steps: int = 40) -> Consequence:
    """A shift of 1 changes the return by ``cost``."""
    found = jointly(seed, steps, shift=shift)
    changes = cost * found.draws(64, np.random.default_rng(seed))[:, 1, 0]
    return Consequence(found, changes, PROMISE, slack=10.0)


def test_a_systematic_model_error_that_lowers_the_return_counts_as_proven():
    assert consequence(0, shift=1.5, cost=-60.0).proven


def test_a_systematic_error_without_effect_on_the_return_keeps_the_promised_return():
    harmless = consequence(0, shift=1.5, cost=-5.0)
    assert harmless.shifted.evidence > 20
    assert not harmless.proven
    assert not harmless.undecided
    assert harmless.widened(PROMISE) is PROMISE


def test_a_possible_costly_systematic_error_requires_more_steps_and_widens_the_promised_interval():
    possible = consequence(0, shift=0.9, cost=-150.0, steps=8)
    assert possible.shifted.evidence < 20
    assert possible.undecided
    wider = possible.widened(PROMISE)
    assert wider.low < PROMISE.low - 10
    assert wider.high <= PROMISE.high + 1


def test_the_input_region_of_a_systematic_error_is_found():
    rng = np.random.default_rng(0)
    values = rng.uniform(-1, 1, (300, 2))
    errors = 0.1 * rng.standard_normal(300) + np.where(values[:, 1] > 0.4, 0.5, 0.0)
    found = region(["x", "u"], values, errors)
    assert found is not None
    assert found.name == "u"
    assert found.low > 0
    assert found.error > 0.3
    assert region(["x", "u"], values, 0.1 * rng.standard_normal(300)) is None


def test_the_inputs_of_a_systematic_error_encode_angles_by_cosine_and_sine():
    rng = np.random.default_rng(0)
    q, u = rng.uniform(-3, 3, (50, 2)), rng.uniform(-2, 2, (50, 1))
    inputs = Inputs.over(pendulum(), q, u)
    assert len(inputs.centre) == 4
    at = inputs.at(pendulum(), q, u)
    assert at.shape == (50, 5)
    assert at[:, 1:].mean(0) == pytest.approx(np.zeros(4), abs=1e-9)
    turned = q + np.array([2 * np.pi, 0.0])
    assert inputs.at(pendulum(), turned, u) == pytest.approx(at)
