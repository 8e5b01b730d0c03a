"""What people see of sessions: sums that agree with the steps, whatever the number of lanes and of repeats."""

from __future__ import annotations

import numpy as np
import pytest

from surrogym_server.engine import tallies
from surrogym_server.engine.requests import Reply
from surrogym_server.engine.tallies import Tally
from surrogym_shared.port import PolicyRollout, StepResult


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


def result(reward: list[float], ended: list[bool], penalty: float = 0.5) -> StepResult:
    lanes = len(reward)
    none = np.zeros(lanes, dtype=bool)
    return StepResult(
        observation=np.zeros((lanes, 1)),
        reward=np.array(reward),
        terminated=np.array(ended),
        truncated=none,
        final_lanes=np.zeros(0, dtype=int),
        final_observation=np.zeros((0, 1)),
        model_version=np.ones(lanes, dtype=int),
        reward_mean=np.array(reward) + penalty,
        deviation=None,
    )


def answer(seq: int, *results: StepResult) -> Reply:
    return Reply(seq, results)


@pytest.mark.parametrize("gathered", [1, 10**6])
def test_the_episode_return_is_the_sum_of_rewards_between_episode_ends(gathered: int, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(tallies, "FOLD_LANE_STEPS", gathered)
    tally = Tally(Clock())
    tally.stepped(answer(2, result([1, 10], [False, False])))
    tally.stepped(answer(3, result([2, 20], [True, False]), result([4, 40], [False, True])))
    tally.stepped(answer(3, result([9, 9], [True, True])))  # a repeat
    tally.stepped(answer(4, result([8, 80], [True, False])))
    read = tally.read(None)  # type: ignore[arg-type]
    assert (read.steps, read.episodes) == (8, 3)
    assert [episode.reward for episode in read.recent] == [3, 70, 12]
    assert [episode.penalty for episode in read.recent] == [1.0, 1.5, 1.0]


def test_rollout_steps_are_counted_like_single_steps_in_statistics():
    several, one = Tally(Clock()), Tally(Clock())
    steps = [result([1, 10], [False, False]), result([2, 20], [True, False]), result([4, 40], [False, True])]
    one.stepped(answer(2, *steps))
    several.stepped(Reply(2, PolicyRollout.of(steps, np.zeros((3, 2, 1)), None)))
    for tally in (several, one):
        tally.stepped(answer(3, result([8, 80], [True, False])))
    assert several.read(None) == one.read(None)  # type: ignore[arg-type]


def test_a_reset_drops_unfinished_episodes_from_the_statistics():
    tally = Tally(Clock())
    tally.stepped(answer(2, result([1, 10], [False, False])))
    tally.reset(np.array([True, False]))
    tally.stepped(answer(4, result([2, 20], [True, True])))
    assert [episode.reward for episode in tally.read(None).recent] == [2, 30]  # type: ignore[arg-type]


def test_the_steps_per_second_figure_falls_when_no_steps_arrive():
    clock = Clock()
    tally = Tally(clock)
    for seq in range(2, 102):
        clock.now += 0.01
        tally.stepped(answer(seq, result([0.0], [False])))
    assert tally.read(None).steps_per_second == pytest.approx(100, rel=0.1)  # type: ignore[arg-type]
    clock.now += 60
    assert tally.read(None).steps_per_second < 1  # type: ignore[arg-type]
