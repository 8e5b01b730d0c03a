"""The promise: an interval for the mean of 100 real starts, from episodes of several functions and starts."""

import numpy as np
import pytest

from surrogym_client.transport import HttpSurrogate
from surrogym_trainer.evaluation.promise import EVALUATION_STARTS, FUNCTIONS, STARTS, UNNOTICED, interval, promise_of

Z = 1.6449  # of a standard normal's 95 % quantile


def test_if_returns_vary_only_by_start_the_promised_interval_equals_that_of_a_mean():
    returns = np.repeat(np.random.default_rng(0).normal(-100, 20, (400, 1)), 32, axis=1)
    promise = interval(returns, floor=-100.0)
    spread = 20 * np.sqrt(1 / EVALUATION_STARTS + 1 / returns.size)
    assert promise.median == pytest.approx(returns.mean())
    assert promise.median - promise.low == pytest.approx(Z * spread, rel=0.1)
    assert promise.high - promise.median == pytest.approx(Z * spread, rel=0.1)


def test_the_promised_return_interval_has_a_minimum_width_if_posterior_draws_agree():
    returns = np.repeat(np.random.default_rng(0).normal(-20, 0.5, (400, 1)), 32, axis=1)
    promise = interval(returns, floor=-120.0)
    assert promise.median - promise.low == pytest.approx(UNNOTICED * 100, rel=0.1)
    assert promise.high - promise.median > UNNOTICED * 50


def test_the_promised_return_interval_stays_within_the_range_of_episode_returns():
    promise = interval(np.full((STARTS, FUNCTIONS), 500.0), floor=20.0)
    assert (promise.low, promise.median, promise.high) == (500.0, 500.0, 500.0)


def test_posterior_draws_that_disagree_widen_the_promised_return_interval():
    returns = np.tile(np.random.default_rng(0).normal(0, 50, 32), (8, 1))
    promise = interval(returns)
    low, high = np.quantile(returns[0], [0.05, 0.95])
    assert (promise.low, promise.high) == pytest.approx((low, high), abs=12)


def test_random_variation_between_starts_does_not_widen_the_promised_return_interval():
    rng = np.random.default_rng(1)
    widths = []
    for _ in range(50):
        promise = interval(rng.normal(0, 10, (STARTS, FUNCTIONS)))
        widths.append(promise.high - promise.low)
    by_means = 2 * Z * 10 / np.sqrt(STARTS)
    assert np.median(widths) < 0.6 * by_means, "means of eight starts alone would be taken for that"


@pytest.mark.parametrize("between", [0.0, 5.0, 30.0])
def test_the_promised_return_interval_covers_90_percent_of_new_mean_returns(between: float):
    rng = np.random.default_rng(2)
    inside = 0
    for _ in range(2_000):
        functions = rng.normal(0, between, FUNCTIONS + 1)
        promise = interval(rng.normal(functions[1:], 10.0, (STARTS, FUNCTIONS)))
        real = rng.normal(functions[0], 10.0, EVALUATION_STARTS).mean()
        inside += promise.low <= real <= promise.high
    assert 0.87 <= inside / 2_000 <= 0.985


def test_a_promised_return_ignores_reward_penalties_and_is_reproducible(pendulum_server):
    with HttpSurrogate(pendulum_server.url, "pendulum") as port:
        still = lambda observation: np.zeros((len(observation), 1))  # noqa: E731
        plain, penalised, again = (
            promise_of(port, still, 3, options) for options in ({}, {"penalty": 5.0, "caution": 2.0}, {})
        )
        other = promise_of(port, still, 4)
    assert plain == penalised == again
    assert plain != other
    assert plain.low < plain.median < plain.high < 0
