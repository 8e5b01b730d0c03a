"""The promise: an interval for the mean of 100 real starts, from episodes of several functions and starts."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import surrogym
from support.limited import SPEC, PatientCart, with_limits
from surrogym_client.transport import HttpSurrogate
from surrogym_sampler.original.episodes import open_episode
from surrogym_sampler.original.rollouts import answering, keeping_limits
from surrogym_server.local import LocalSurrogate
from surrogym_shared.spec import EnvironmentSpec
from surrogym_trainer.evaluation.evaluator import EvaluationSettings, evaluate
from surrogym_trainer.evaluation.promise import (
    EVALUATION_STARTS,
    FUNCTIONS,
    STARTS,
    UNNOTICED,
    fallback_share,
    interval,
    promise_of,
)

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
        plain, penalised, again = (promise_of(port, still, 3, options) for options in ({}, {"penalty": 5.0}, {}))
        other = promise_of(port, still, 4)
    assert plain == penalised == again
    assert plain != other
    assert plain.low < plain.median < plain.high < 0


def learned(spec: EnvironmentSpec) -> LocalSurrogate:
    """The cart, learned by its design from resets."""
    cart: Any = keeping_limits(answering(PatientCart(spec)))
    design = surrogym.Design(spec, threads=1)
    while (query := design.ask()) is not None:
        cart.begin(query.id)
        design.tell(query, [cart.act(np.array(action)) for action in query.actions])
    return design.surrogate()


PUSHES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "always to the right": lambda shown: np.ones((len(shown), 1)),
    "towards the middle": lambda shown: np.clip(-shown[:, :1] - shown[:, 1:], -1, 1),
    "to the right where it starts there": lambda shown: np.where(shown[:, :1] + 0.3 * shown[:, 1:] > 0, 1.0, -0.05),
}


def test_the_predicted_share_of_episodes_with_a_fallback_agrees_with_real_episodes():
    model = learned(SPEC)
    for name, policy in PUSHES.items():
        fallback = promise_of(model, policy, 0).fallback
        settings = EvaluationSettings(episodes=40)
        real = evaluate(policy, lambda: open_episode("cart:Cart", SPEC, PatientCart), settings).limits
        assert fallback is not None
        assert real is not None
        assert fallback.low - 0.05 <= real.fallback_episodes / 40 <= fallback.high + 0.05, name
        assert " as often as expected" in real.expected(fallback.low, fallback.high)


def test_without_limits_a_promise_says_nothing_about_a_fallback():
    assert promise_of(learned(with_limits(None)), PUSHES["towards the middle"], 0).fallback is None


def test_a_fallback_that_no_virtual_episode_shows_is_expected_in_at_most_the_share_that_could_be_missed():
    never = fallback_share(np.zeros((STARTS, FUNCTIONS), dtype=bool))
    assert (never.low, never.median) == (0.0, 0.0)
    assert (1 - never.high) ** FUNCTIONS == pytest.approx(0.05)
    always = fallback_share(np.ones((STARTS, FUNCTIONS), dtype=bool))
    assert (always.low, always.median, always.high) == (pytest.approx(1 - never.high), 1.0, 1.0)


@pytest.mark.parametrize(("bad", "all_or_nothing"), [(1, True), (1, False), (FUNCTIONS - 1, True)])
def test_the_interval_of_a_share_contains_its_mean_if_all_fallbacks_are_along_few_functions(
    bad: int, all_or_nothing: bool
):
    fallen = np.zeros((STARTS, FUNCTIONS), dtype=bool)
    fallen[: None if all_or_nothing else 1, :bad] = True
    share = fallback_share(fallen)
    assert share.mean == fallen.mean()
    assert share.low <= fallen.mean() <= share.high
    assert f"expected in {100 * fallen.mean():.2g} % of the episodes" in share.words()


@pytest.mark.parametrize("share", [0.02, 0.2, 0.6])
def test_the_interval_of_a_share_covers_90_percent_of_real_shares(share: float):
    rng = np.random.default_rng(3)
    inside = 0
    for _ in range(500):
        predicted = fallback_share(rng.random((STARTS, FUNCTIONS)) < share)
        inside += predicted.low <= rng.binomial(EVALUATION_STARTS, share) / EVALUATION_STARTS <= predicted.high
    assert inside / 500 >= 0.86
