"""Lanes that are talked to one by one, as by tianshou, are like environments of their own, and share their requests."""

import numpy as np
import pytest

from support.exact_pendulum import ExactEnv, ExactPendulum
from surrogym_client.environments.env import LOST
from surrogym_client.environments.lane_calls import LaneCalls
from surrogym_client.environments.lanes import Lanes, session_request
from surrogym_client.errors import NotReset

LANES = 4
ALL = range(LANES)
NOTHING = np.zeros(1, dtype=np.float32)


@pytest.fixture
def port() -> ExactPendulum:
    return ExactPendulum()


@pytest.fixture
def calls(port: ExactPendulum) -> LaneCalls:
    return LaneCalls(Lanes(port, session_request(LANES, "disabled", {})))


def reset(calls: LaneCalls, lanes, seeds=None) -> dict[int, tuple]:
    for lane in lanes:
        calls.reset(lane, None if seeds is None else seeds[lane])
    return {lane: calls.answer(lane) for lane in lanes}


def step(calls: LaneCalls, lanes, action=NOTHING) -> dict[int, tuple]:
    for lane in lanes:
        calls.step(lane, action)
    return {lane: calls.answer(lane) for lane in lanes}


def assert_same(ours: tuple, theirs: tuple) -> None:
    np.testing.assert_array_equal(ours[0], theirs[0])
    assert ours[1:] == theirs[1:]


def test_lanes_are_environments_of_their_own(calls: LaneCalls):
    """In each round some of the lanes act, and those that ended are reset, as by a collector of so many episodes."""
    references, rng, ends = [ExactEnv() for _ in ALL], np.random.default_rng(0), 0
    for lane, start in reset(calls, ALL, seeds=[5, 6, 7, 8]).items():
        assert_same(start, references[lane].reset(seed=5 + lane))
    for _ in range(60):
        acting = np.flatnonzero(rng.uniform(size=LANES) < 0.7).tolist()
        action = rng.uniform(-2, 2, 1).astype(np.float32)
        stepped = step(calls, acting, action)
        for lane, ours in stepped.items():
            assert_same(ours, references[lane].step(action))
        over = [lane for lane, ours in stepped.items() if ours[2] or ours[3]]
        for lane, start in reset(calls, over).items():
            assert_same(start, references[lane].reset())
        ends += len(over)
    assert ends > LANES


def test_a_round_is_one_request(calls: LaneCalls, port: ExactPendulum, monkeypatch: pytest.MonkeyPatch):
    reset(calls, ALL)
    masks, ask = [], port.step

    def noting(*args, **options):
        masks.append(options["mask"])
        return ask(*args, **options)

    monkeypatch.setattr(port, "step", noting)
    step(calls, ALL)
    step(calls, [1, 3])
    assert masks[0] is None
    np.testing.assert_array_equal(masks[1:], [[False, True, False, True]])


def test_a_lane_that_ended_has_to_be_reset(calls: LaneCalls):
    reset(calls, ALL)
    over: list[int] = []
    while not over:
        over = [lane for lane, ours in step(calls, ALL).items() if ours[2] or ours[3]]
    with pytest.raises(NotReset):
        step(calls, over)
    reset(calls, over)
    step(calls, over)


def test_a_lost_session_ends_each_episode_when_its_lane_is_next_stepped(calls: LaneCalls, port: ExactPendulum):
    reset(calls, ALL)
    last = {lane: ours[0] for lane, ours in step(calls, ALL).items()}
    port.lose()
    for some in ([0, 1], [2]):
        for lane, (observation, reward, terminated, truncated, info) in step(calls, some).items():
            np.testing.assert_array_equal(observation, last[lane])
            assert (reward, terminated, truncated) == (0.0, False, True)
            assert "lost with a crash" in info[LOST]
    reset(calls, ALL)
    assert not any(ours[3] or LOST in ours[4] for ours in step(calls, ALL).values())
