"""What is compared with a policy does not look at the state, and stays within the actions of the environment."""

from __future__ import annotations

import numpy as np
import pytest

from surrogym_sampler.original.actions import decode_actions
from surrogym_sampler.original.classic import cartpole, pendulum
from surrogym_shared.spec import BoxAction
from surrogym_trainer.evaluation.baselines import baseline, default_baseline
from surrogym_trainer.evaluation.evaluator import Evaluation, EvaluationSettings, Trace
from surrogym_trainer.evaluation.reporting import as_reported, paired_start


def test_the_uncontrolled_baseline_uses_zero_actions_or_random_discrete_ones():
    assert default_baseline(pendulum()) == "zero"
    assert default_baseline(cartpole()) == "random"
    positive = pendulum().model_copy(update={"action": BoxAction(low=(1.0,), high=(2.0,))})
    assert default_baseline(positive) == "random"
    with pytest.raises(ValueError, match="do not include zero"):
        baseline(positive, "zero")


def test_the_uncontrolled_baseline_uses_valid_actions():
    observations = np.zeros((500, 3), dtype=np.float32)
    zero = decode_actions(pendulum(), baseline(pendulum(), "zero")(observations), 500)
    assert not zero.any()
    drawn = decode_actions(pendulum(), baseline(pendulum(), "random")(observations), 500)
    assert -2 <= drawn.min() < -1.8 < 1.8 < drawn.max() <= 2
    chosen = decode_actions(cartpole(), baseline(cartpole(), "random")(observations), 500)
    assert set(np.unique(chosen)) == {0.0, 1.0}


def test_paired_best_median_and_worst_episodes_are_reported_with_seeds():
    returns = np.array([-3.0, -1.0, -5.0, -2.0])
    traces = tuple(Trace(np.full((2, 2), r), np.zeros((1, 1)), np.array([r])) for r in returns)
    result = Evaluation(returns, np.ones(4, dtype=np.int64), np.array([True, True, False, True]), traces)
    said = as_reported(result, EvaluationSettings(episodes=4, first_seed=100, wide=True), "key", paired=3)
    assert {trace.rank: (trace.seed, trace.reward) for trace in said.traces} == {
        "paired": (103, [-2.0]),
        "best": (101, [-1.0]),
        "median": (100, [-3.0]),
        "worst": (102, [-5.0]),
    }
    assert [paired_start(result, among) for among in (1, 2, 4)] == [0, 0, 0]
    assert (said.returns, said.success, said.declared) == (returns.tolist(), [True, True, False, True], False)
    assert said.note == "starts anywhere in the sampling range, from seed 100"


def test_the_largest_evaluation_report_fits_into_a_request():
    rng, steps = np.random.default_rng(0), 2_000
    trace = Trace(rng.normal(size=(steps + 1, 64)), rng.normal(size=(steps, 64)), rng.normal(size=steps))
    result = Evaluation(rng.normal(size=10_000), np.full(10_000, steps), None, (trace,) * 10_000)
    said = as_reported(result, EvaluationSettings(episodes=10_000), "key")
    assert len(said.traces) == 4
    assert len(said.model_dump_json()) < 4 * 1024**2
