"""A lost session ends its episodes as truncated, says why, and goes on in a new one; no silent reset."""

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from support.exact_pendulum import ExactPendulum
from surrogym_client.environments import RemoteVectorEnv
from surrogym_client.environments.env import LOST, RemoteEnv
from surrogym_client.errors import SessionExpired
from surrogym_client.sb3 import SurrogateVecEnv

LANES = 3
ZERO = np.zeros((LANES, 1), dtype=np.float32)


@pytest.fixture
def port() -> ExactPendulum:
    return ExactPendulum()


def vector(port: ExactPendulum, mode: AutoresetMode) -> RemoteVectorEnv:
    envs = RemoteVectorEnv(port, LANES, autoreset_mode=mode)
    envs.reset(seed=[1, 2, 3])
    return envs


def start_of_new_session(port: ExactPendulum) -> np.ndarray:
    lanes = next(iter(port.sessions.values())).lanes
    return np.stack([type(lane)(lane.seed, lane.lane).reset() for lane in lanes])


def test_a_lost_session_truncates_the_episode_and_reset_starts_a_new_one(port: ExactPendulum):
    env = RemoteEnv(port, seed=5)
    env.reset()
    last, *_ = env.step(ZERO[0])
    port.lose()
    observation, reward, terminated, truncated, info = env.step(ZERO[0])
    np.testing.assert_array_equal(observation, last)
    assert (reward, terminated, truncated) == (0.0, False, True)
    assert "lost with a crash" in info[LOST]
    env.reset()
    assert LOST not in env.step(ZERO[0])[-1]


def test_after_a_lost_session_autoreset_mode_next_step_returns_the_new_start_one_step_later(port: ExactPendulum):
    envs = vector(port, AutoresetMode.NEXT_STEP)
    last, *_ = envs.step(ZERO)
    port.lose()
    observation, reward, terminated, truncated, infos = envs.step(ZERO)
    np.testing.assert_array_equal(observation, last)
    assert truncated.all()
    assert not terminated.any()
    assert not reward.any()
    assert infos[f"_{LOST}"].all()
    start, reward, terminated, truncated, infos = envs.step(ZERO)
    np.testing.assert_array_equal(start, start_of_new_session(port))
    assert not (terminated | truncated).any()
    assert LOST not in infos
    assert "reward_mean" not in infos, "an autoreset step has only the infos of a reset"
    moved, *_ = envs.step(ZERO)
    assert not np.array_equal(moved, start)


def test_a_lost_session_does_not_end_an_already_ended_episode_again(port: ExactPendulum):
    """A lane that had ended before the loss is only shown its new start."""
    envs = vector(port, AutoresetMode.NEXT_STEP)
    over = np.zeros(LANES, dtype=bool)
    while not over.any():
        observation, _, terminated, truncated, _ = envs.step(ZERO)
        over = terminated | truncated
    assert not over.all()
    port.lose()
    shown, _, _, truncated, infos = envs.step(ZERO)
    np.testing.assert_array_equal(truncated, ~over)
    np.testing.assert_array_equal(infos[f"_{LOST}"], ~over)
    np.testing.assert_array_equal(shown[over], start_of_new_session(port)[over])
    np.testing.assert_array_equal(shown[~over], observation[~over])
    following, *_ = envs.step(ZERO)
    np.testing.assert_array_equal(following[~over], start_of_new_session(port)[~over])
    assert not np.array_equal(following[over], start_of_new_session(port)[over])


def test_after_a_lost_session_autoreset_mode_same_step_returns_the_last_observation_as_final(port: ExactPendulum):
    envs = vector(port, AutoresetMode.SAME_STEP)
    last, *_ = envs.step(ZERO)
    port.lose()
    observation, _, _, truncated, infos = envs.step(ZERO)
    assert truncated.all()
    np.testing.assert_array_equal(np.stack(infos["final_obs"]), last)
    np.testing.assert_array_equal(observation, start_of_new_session(port))
    assert all("lost with a crash" in reason for reason in infos["final_info"][LOST])
    assert LOST not in infos


def test_after_a_lost_session_stable_baselines3_bootstraps_from_the_last_observation(port: ExactPendulum):
    envs = SurrogateVecEnv.from_port(port, LANES)
    last = envs.reset()
    port.lose()
    observation, _, done, infos = envs.step(ZERO)
    assert done.all()
    np.testing.assert_array_equal(observation, start_of_new_session(port))
    for lane, info in enumerate(infos):
        assert info["TimeLimit.truncated"]
        np.testing.assert_array_equal(info["terminal_observation"], last[lane])
        assert "lost with a crash" in info[LOST]


def test_after_a_lost_session_autoreset_mode_disabled_waits_for_a_reset(port: ExactPendulum):
    envs = vector(port, AutoresetMode.DISABLED)
    last, *_ = envs.step(ZERO)
    port.lose()
    observation, _, _, truncated, infos = envs.step(ZERO)
    np.testing.assert_array_equal(observation, last)
    assert truncated.all()
    assert infos[f"_{LOST}"].all()
    _, infos = envs.reset(options={"reset_mask": truncated})
    assert LOST not in infos
    assert not envs.step(ZERO)[3].any()


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_a_lost_session_found_by_a_masked_reset_truncates_the_other_environments(
    port: ExactPendulum, mode: AutoresetMode
):
    envs = vector(port, mode)
    last, *_ = envs.step(ZERO)
    port.lose()
    mask = np.array([True, False, False])
    observation, infos = envs.reset(seed=[9, 9, 9], options={"reset_mask": mask})
    np.testing.assert_array_equal(observation[~mask], last[~mask])
    np.testing.assert_array_equal(infos[f"_{LOST}"], mask)
    shown, _, _, truncated, infos = envs.step(ZERO)
    np.testing.assert_array_equal(truncated, ~mask)
    assert not np.array_equal(shown[mask], observation[mask]), "the lane that was reset moves on"
    same_step = mode is AutoresetMode.SAME_STEP
    final = np.stack(infos["final_obs"][~mask]) if same_step else shown[~mask]
    np.testing.assert_array_equal(final, last[~mask])
    reasons = infos["final_info"] if same_step else infos
    np.testing.assert_array_equal(reasons[f"_{LOST}"], ~mask)


def test_a_lost_session_found_by_a_full_reset_is_reported(port: ExactPendulum):
    env = RemoteEnv(port)
    first, _ = env.reset(seed=1)
    port.lose()
    again, info = env.reset(seed=1)
    np.testing.assert_array_equal(again, first)
    assert "lost with a crash" in info[LOST]


def test_a_session_that_replaces_a_lost_one_has_new_seeds_and_the_same_settings(port: ExactPendulum):
    def run(seed: int) -> list[int]:
        own = ExactPendulum()
        env = RemoteEnv(own, seed=seed, penalty=2.0)
        for _ in range(3):
            env.reset()
            own.lose()
        assert {request.penalty for request in own.opened} == {2.0}
        return [request.seed for request in own.opened]

    assert run(5) == run(5)
    assert len(set(run(5) + run(6))) == 6


def test_the_client_gives_up_if_every_new_session_is_lost_at_once(port: ExactPendulum):
    envs = vector(port, AutoresetMode.SAME_STEP)
    opened = port.open

    def open_and_lose(request):
        view = opened(request)
        port.lose()
        return view

    port.lose()
    port.open = open_and_lose
    with pytest.raises(SessionExpired):
        envs.step(ZERO)
    assert len(port.opened) < 10
