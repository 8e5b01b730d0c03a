"""The audit's judgement: right models pass, wrong ones fail, and errors within the tolerance are no fault."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.stats

from surrogym_sampler.original.classic import pendulum
from surrogym_shared.spec import with_history
from surrogym_trainer.evaluation.audit import Compared, chi_squared, differences, gaps, judge, places, untested
from surrogym_trainer.policies.evidence import Promise

PROMISE = Promise(median=-150.0, low=-160.0, high=-140.0, functions=32, episodes=256)
UNTRAINED = -1_200.0


def compared(errors: np.ndarray, deviation: float = 1.0, expected: float = 0.5, misplaced: int = 0) -> Compared:
    names = [f"output {i}" for i in range(errors.shape[1])]
    return Compared(names, errors, np.full(errors.shape, deviation), np.full(errors.shape[1], expected), misplaced)


def test_an_audit_fails_at_most_one_in_fifty_correct_models():
    rng = np.random.default_rng(0)
    failed = sum(
        not judge(compared(rng.normal(0, np.hypot(1.0, 0.5), (8, 3))), PROMISE, PROMISE, UNTRAINED).passed
        for _ in range(1_000)
    )
    assert failed <= 20


@pytest.mark.parametrize("factor", [3.0, 10.0])
def test_an_audit_fails_a_model_whose_errors_exceed_its_predicted_deviation(factor: float):
    errors = factor * np.random.default_rng(0).normal(0, np.hypot(1.0, 0.5), (8, 2))
    errors[:, 0] = 0.0
    audit = judge(compared(errors), PROMISE, PROMISE, UNTRAINED)
    assert not audit.passed
    [fault] = audit.faults
    assert fault.startswith("output 1: errors of")


def test_errors_within_the_tolerance_never_fail_an_audit():
    errors = np.full((8, 2), 0.5)
    assert judge(compared(errors, deviation=1e-9), PROMISE, PROMISE, UNTRAINED).passed


def test_errors_beyond_the_predicted_deviation_are_noted_although_the_audit_passes():
    """A heavier pendulum's errors were 2.4 times the model's claim, within the tolerance, and nothing asked further."""
    claimed, rng = np.array([0.2, 0.2]), np.random.default_rng(0)
    right = [compared(rng.normal(0, 0.2, (8, 2)), deviation=1e-9) for _ in range(500)]
    assert sum(replace(one, claimed_alone=claimed).surprising.any() for one in right) <= 10
    errors = rng.normal(0, [0.2, 0.5], (8, 2))
    larger = replace(compared(errors, deviation=1e-9), claimed_alone=claimed)
    assert larger.surprising.tolist() == [False, True]
    assert judge(larger, PROMISE, PROMISE, UNTRAINED).passed
    at_the_end = replace(right[0], errors=np.r_[np.zeros((7, 2)), [[0.0, 2.0]]], claimed_alone=claimed)
    assert at_the_end.surprising.any()
    assert not replace(at_the_end, elsewhere=1).surprising.any(), "off the policy's way, it says nothing of the return"


@pytest.mark.parametrize(
    ("after", "passed"), [(-155.0, True), (-250.0, True), (-300.0, False), (-60.0, True), (0.0, False)]
)
def test_an_audit_fails_if_its_samples_change_the_promised_return_too_much(after: float, passed: bool):
    later = Promise(median=after, low=after - 10, high=after + 10, functions=32, episodes=256)
    assert judge(compared(np.zeros((8, 1))), PROMISE, later, UNTRAINED).passed is passed


@pytest.mark.parametrize(("misplaced", "passed"), [(0, True), (1, True), (2, False)])
def test_an_audit_fails_if_terminations_contradict_the_prediction(misplaced: int, passed: bool):
    assert judge(compared(np.zeros((8, 1)), misplaced=misplaced), PROMISE, PROMISE, UNTRAINED).passed is passed


def test_an_audit_rollout_fails_by_one_unpredicted_termination():
    """An episode ends at most once. So one misplaced end fails a rollout, where it takes two to fail single steps."""
    beside = replace(compared(np.zeros((3, 1)), misplaced=1), cut_short=True)
    assert judge(beside, PROMISE, PROMISE, UNTRAINED).faults == (
        "a rollout ended at a step where the model predicted no end",
    )


def test_an_audit_fails_if_the_environment_failed_at_a_query():
    audit = judge(replace(compared(np.zeros((7, 1))), unanswered=1), PROMISE, PROMISE, UNTRAINED)
    assert audit.faults == ("the original environment failed at 1 of 8 queries, so nothing is known there",)


@pytest.mark.parametrize("degrees", [1, 2, 8, 64])
def test_the_chi_squared_quantile_approximates_that_of_scipy(degrees: int):
    for above in (0.05, 0.01, 0.001):
        assert chi_squared(degrees, above) == pytest.approx(scipy.stats.chi2.isf(above, degrees), rel=0.06)


def test_audit_states_spread_over_the_visited_states_within_the_sampling_range():
    rng = np.random.default_rng(0)
    q = np.concatenate([rng.normal(0, 0.01, (500, 2)), [[3.0, 0.0], [-3.0, 7.0], [0.0, 7.5], [0.0, 80.0]]])
    chosen = places(pendulum(), q, np.zeros((len(q), 1)), 8, rng)
    assert len(set(chosen.tolist())) == 8
    assert {501, 502} <= set(chosen.tolist()), "what lies far from the rest"
    assert 503 not in chosen, "the environment can't be set there"


def test_with_few_visited_states_an_audit_checks_each_of_them_once():
    q = np.zeros((3, 2))
    assert sorted(places(pendulum(), q, np.zeros((3, 1)), 8, np.random.default_rng(0))) == [0, 1, 2]
    assert len(places(pendulum(), q + 1e3, np.zeros((3, 1)), 8, np.random.default_rng(0))) == 0


def test_an_audit_tests_the_model_in_the_widest_ranges_of_an_input_without_samples():
    """Samples everywhere but beyond a speed of 4, and with small torques alone. Angles have no end, so no gap there."""
    rng = np.random.default_rng(0)
    q, u = rng.uniform([-np.pi, -8], [np.pi, 8], (1_000, 2)), rng.uniform(-2, 2, (1_000, 1))
    samples = rng.uniform([-3.1, -8], [3.1, 4], (100, 2)), rng.uniform(-2, 0, (100, 1))
    first, second = gaps(pendulum(), q, u, samples, 2)
    assert u[first, 0] > 1.98, "half of the torques"
    assert q[second, 1] > 7.9, "a quarter of the speeds"


def test_audit_points_in_gaps_between_samples_are_within_the_sampling_range_and_few():
    q, u = np.array([[0.0, 0.0], [0.1, 2.0], [0.0, 80.0]]), np.zeros((3, 1))
    samples = np.array([[0.0, 0.1]]), np.zeros((1, 1))
    assert gaps(pendulum(), q, u, samples, 1) == [1]
    assert sorted(gaps(pendulum(), q, u, samples, 2)) == [0, 1]
    assert len(gaps(pendulum(), q, u, samples, 0)) == 0


def test_states_far_from_an_audit_are_untested_whatever_actions_they_repeat():
    late = with_history(pendulum().model_copy(update={"query": "rollout"}), actions=2)
    rng = np.random.default_rng(0)
    actions = rng.uniform(-2, 2, (2, 400, 2))
    way, audited = (np.concatenate([rng.normal(0, 0.1, (400, 2)), u], 1) for u in actions)
    assert untested(late, way, audited) < 0.05
    fast = np.concatenate([way[:300], way[300:] + np.array([0.0, 5.0, 0.0, 0.0])])
    assert untested(late, fast, audited) == pytest.approx(0.25, abs=0.02)


def test_audit_errors_of_angles_take_the_shorter_direction():
    difference = differences(pendulum(), np.array([[3.1, 1.0]]), np.array([[-3.1, 0.5]]))
    assert difference[0].tolist() == pytest.approx([6.2 - 2 * np.pi, 0.5])
