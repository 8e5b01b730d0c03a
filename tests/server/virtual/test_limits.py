"""Limits of virtual rewards: what lies far beyond every sample is cut, before any penalty."""

from dataclasses import replace

import numpy as np
import pytest

from surrogym_server.virtual import LaneTransition, reward_limits, within

NONE = np.zeros(0)


def transition(mean: list[float], penalty: float = 0.0) -> LaneTransition:
    rewards, flags = np.array(mean), np.zeros(len(mean), dtype=bool)
    return LaneTransition(NONE, rewards - penalty, flags, flags, NONE, NONE, flags, rewards, None, None)


@pytest.mark.parametrize(
    ("seen", "limits"),
    [((-16.0, 0.0), (-32.0, 16.0)), ((1.0, 1.0), (0.0, 2.0)), ((0.0, 0.0), (0.0, 0.0)), ((5.0, 7.0), (-2.0, 14.0))],
)
def test_virtual_reward_limits_extend_the_sampled_range_and_include_zero(
    seen: tuple[float, float], limits: tuple[float, float]
):
    assert reward_limits(*seen) == limits


def test_the_uncertainty_penalty_is_subtracted_after_limiting_the_reward():
    kept = within((-1.0, 2.0), transition([1e12, -1e12, 0.5], penalty=3.0))
    assert kept.reward_mean.tolist() == [2.0, -1.0, 0.5]
    assert kept.reward.tolist() == pytest.approx([-1.0, -4.0, -2.5], abs=1e-3)


def test_virtual_rewards_within_the_limits_are_unchanged():
    same = transition([0.5, -0.5])
    assert within((-1.0, 1.0), same) is same
    assert within(None, same) is same


def test_the_reward_for_leaving_the_sampling_range_is_exempt_from_reward_limits():
    left = np.array([True, False])
    kept = within((-2.0, 2.0), replace(transition([-200.0, -200.0]), left=left))
    assert kept.reward.tolist() == [-200.0, -2.0]
