"""What checks of a training decide: whether a network has learned, whether a cycle gained, and when to stop."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from surrogym_trainer.training.checks import Checks, Returns

BEST = 97.0  # that an episode earned


def episodes(successes: int, earned: float = 90.0) -> Returns:
    """Returns of 64 episodes, of which some succeed."""
    return np.where(np.arange(64) < successes, earned, -0.1)


UNTRAINED = episodes(3, BEST)  # three of 64 posterior samples reach the goal by themselves


def after(untrained: Returns, *checks: Returns, earned: float = BEST, saved: Returns | None = None) -> Checks:
    found = Checks(untrained, saved)
    found.saw([earned])
    for returns in checks:
        found.add(returns)
    return found


@pytest.mark.parametrize(
    ("successes", "learned"), [(6, False), (22, True), (64, True)], ids=["a few more", "a third", "all"]
)
def test_a_network_counts_as_trained_if_a_quarter_of_its_episodes_earn_more_than_before(successes: int, learned: bool):
    assert after(UNTRAINED, episodes(successes)).learned is learned


def test_a_network_whose_mean_return_did_not_rise_has_not_learned():
    assert not after(UNTRAINED, episodes(22, 10.0)).learned


@pytest.mark.parametrize(("successes", "learned"), [(58, True), (20, False)], ids=["most starts", "no other start"])
def test_if_the_untrained_policy_often_succeeds_learning_is_judged_by_the_mean_return(successes: int, learned: bool):
    assert after(episodes(20, 1.0), episodes(successes, 1.0), earned=1.0).learned is learned


def test_a_new_network_must_reach_half_the_gain_of_the_saved_policy():
    flat = np.ones(64)
    assert not after(-100 * flat, -60 * flat, earned=-10.0, saved=-10 * flat).learned
    assert after(-100 * flat, -50 * flat, earned=-10.0, saved=-10 * flat).learned


def test_training_stops_after_three_checks_with_the_maximum_return():
    full = np.full(64, 500.0)
    assert after(full / 25, full, full, full, earned=500.0).saturated
    assert not after(full / 25, full, full, earned=500.0).saturated


@pytest.mark.parametrize(
    ("untrained", "earned", "checks"),
    [
        pytest.param(20.0, 500.0, [500.0, 499.0, 500.0, 500.0], id="one check earned less"),
        pytest.param(20.0, 500.1, [500.0] * 5, id="some episode earned more"),
        pytest.param(-500.0, -500.0, [-500.0] * 5, id="nothing is learned yet"),
        pytest.param(0.0, 0.0, [0.0] * 5, id="a policy that stands still"),
        pytest.param(-1_200.0, -1.0, [-150.0] * 5, id="a plateau"),
        pytest.param(0.0, 10.0, [50.0, 60.0, 70.0, 80.0, 80.0], id="each check earns more"),
    ],
)
def test_training_continues_while_an_episode_earned_more_than_the_last_checks(
    untrained: float, earned: float, checks: Sequence[float]
):
    flat = np.ones(64)
    assert not after(untrained * flat, *(each * flat for each in checks), earned=earned).saturated


def test_training_continues_while_the_returns_of_a_check_differ():
    """Long episodes end rarely: a policy soon earns more in checks than any finished episode of the training."""
    differ = np.linspace(0, 820, 64)
    assert not after(np.zeros(64), differ, differ, differ, earned=10.0).saturated


def test_a_policy_gain_must_be_significant_and_not_too_small():
    rng = np.random.default_rng(0)
    starts = rng.normal(0, 100, 64)  # good and bad starts, the same for every policy
    untrained, before = starts - 1_000, starts - 100
    assert after(untrained, before, before + 20 + rng.normal(0, 5, 64), earned=0.0).gained(before)
    assert not after(untrained, before, before + 5, earned=0.0).gained(before), "half a per cent of what was gained"
    unsure = before + 20 + 400 * (rng.random(64) < 0.1)
    assert not after(untrained, before, unsure - unsure.mean() + before.mean() + 20, earned=0.0).gained(before)
    assert after(untrained, before, earned=0.0).gained(None), "over an untrained network"
