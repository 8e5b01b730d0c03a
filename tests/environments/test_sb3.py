"""SurrogateVecEnv speaks Stable-Baselines3's dialect: the same as DummyVecEnv on the same trajectory."""

import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from support.exact_pendulum import ExactEnv, ExactPendulum
from surrogym_client.sb3 import SurrogateVecEnv

LANES = 4


@pytest.fixture
def remote() -> SurrogateVecEnv:
    return SurrogateVecEnv.from_port(ExactPendulum(), LANES)


def assert_same_infos(ours: list[dict[str, object]], theirs: list[dict[str, object]]) -> None:
    for our, their in zip(ours, theirs, strict=True):
        assert our.keys() == their.keys()
        for key in our:
            np.testing.assert_array_equal(our[key], their[key], err_msg=key)


def test_the_stable_baselines3_vec_env_gives_the_trajectory_of_dummy_vec_env(remote: SurrogateVecEnv):
    reference = DummyVecEnv([ExactEnv] * LANES)
    assert remote.seed(11) == reference.seed(11)
    np.testing.assert_array_equal(remote.reset(), reference.reset())
    assert_same_infos(remote.reset_infos, reference.reset_infos)
    cut = 0
    for action in np.random.default_rng(1).uniform(-2, 2, (60, LANES, 1)):
        ours, theirs = remote.step(action), reference.step(action)
        for our, their in zip(ours[:3], theirs[:3], strict=True):
            np.testing.assert_array_equal(our, their)
            assert our.dtype == their.dtype
        assert_same_infos(ours[3], theirs[3])
        assert_same_infos(remote.reset_infos, reference.reset_infos)
        cut += sum(info["TimeLimit.truncated"] for info in ours[3])
    assert cut > 3, "expected several episodes to reach the time limit"


def test_an_episode_that_terminates_at_its_time_limit_is_not_marked_truncated():
    def end_of(time_limit: int) -> tuple[int, dict[str, object]]:
        envs = SurrogateVecEnv.from_port(ExactPendulum(), 1, seed=0, time_limit=time_limit)
        envs.reset()
        done, steps = [False], 0
        while not done[0]:
            _, _, done, infos = envs.step(np.full((1, 1), 2.0))
            steps += 1
        return steps, infos[0]

    terminated_at, info = end_of(time_limit=1_000)
    assert not info["TimeLimit.truncated"]
    assert end_of(terminated_at)[0] == terminated_at
    assert not end_of(terminated_at)[1]["TimeLimit.truncated"]
    assert end_of(terminated_at - 1)[1]["TimeLimit.truncated"]


def test_a_seed_set_on_the_vec_env_is_used_by_the_next_reset_only(remote: SurrogateVecEnv):
    remote.seed(3)
    first = remote.reset()
    assert not np.array_equal(remote.reset(), first)
    remote.seed(3)
    np.testing.assert_array_equal(remote.reset(), first)


def test_attributes_set_on_single_environments_of_the_vec_env_are_returned(remote: SurrogateVecEnv):
    remote.set_attr("mark", 1, indices=[0, 2])
    assert remote.get_attr("mark", indices=[0, 2]) == [1, 1]
    assert not remote.has_attr("mark")
    assert remote.get_attr("render_mode") == [None] * LANES
    assert remote.get_attr("action_space", indices=1) == [remote.action_space]
    with pytest.raises(AttributeError, match="no attribute 'gravity'"):
        remote.get_attr("gravity")


def test_calling_a_method_of_the_original_environment_on_the_vec_env_raises(remote: SurrogateVecEnv):
    with pytest.raises(AttributeError, match="no attribute 'fly'"):
        remote.env_method("fly")


def test_the_vec_env_reports_its_environments_as_not_wrapped(remote: SurrogateVecEnv):
    assert remote.env_is_wrapped(Monitor) == [False] * LANES


def test_step_wait_without_step_async_is_refused(remote: SurrogateVecEnv):
    remote.reset()
    with pytest.raises(RuntimeError, match="step_async"):
        remote.step_wait()


def test_a_stable_baselines3_algorithm_trains_on_the_vec_env(remote: SurrogateVecEnv):
    envs = VecMonitor(remote)
    model = PPO("MlpPolicy", envs, n_steps=16, batch_size=32, n_epochs=1, seed=0, device="cpu")
    model.learn(total_timesteps=128)
    assert model.num_timesteps == 128
    assert len(model.ep_info_buffer) > 0


def test_the_vec_env_submits_the_visited_states_of_its_session(remote: SurrogateVecEnv):
    assert remote.submit_occupancy("first").states == LANES
