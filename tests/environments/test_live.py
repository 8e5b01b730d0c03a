"""The environment classes against a real server: the checkers of Gymnasium and Stable-Baselines3 have no complaint."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env, data_equivalence
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from stable_baselines3 import A2C, PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_checker import check_env as check_env_for_sb3
from stable_baselines3.common.evaluation import evaluate_policy

import surrogym_client
from surrogym_client.environments import RemoteVectorEnv
from surrogym_client.environments.env import LOST, RemoteEnv
from surrogym_client.sb3 import SurrogateVecEnv
from surrogym_client.transport import HttpSurrogate

SEEDS = [5, 6, 7]
ID = "surrogym/Remote-v0"

pytestmark = [
    pytest.mark.filterwarnings("ignore:.*symmetric and normalized"),  # Pendulum's torque is in [-2, 2]
    pytest.mark.filterwarnings("ignore:.*not within the observation space:UserWarning"),
]


@pytest.fixture
def port(pendulum_server) -> HttpSurrogate:
    return HttpSurrogate(pendulum_server.url, "pendulum")


@pytest.mark.parametrize("variant", ["deterministic", "probabilistic"])
def test_the_environment_checkers_of_gymnasium_and_stable_baselines3_pass(pendulum_server, variant: str):
    assert surrogym_client.register
    options = {"variant": variant, "particles": 20} if variant == "probabilistic" else {}
    env = gymnasium.make(ID, url=pendulum_server.url, surrogate="pendulum", **options)
    check_env(env.unwrapped, skip_close_check=True)
    check_env_for_sb3(env)
    env.close()


def test_gymnasium_make_returns_one_environment_with_the_servers_time_limit(pendulum_server):
    env = gymnasium.make(ID, url=pendulum_server.url, surrogate="pendulum", time_limit=3)
    assert isinstance(env.unwrapped, RemoteEnv)
    env.reset(seed=0)
    flags = [env.step(np.zeros(1, dtype=np.float32))[2:4] for _ in range(3)]
    assert flags == [(False, False), (False, False), (False, True)]
    env.close()


def test_gymnasium_make_vec_returns_environments_of_one_session(pendulum_server):
    envs = gymnasium.make_vec(ID, num_envs=8, url=pendulum_server.url, surrogate="pendulum")
    assert isinstance(envs, RemoteVectorEnv)
    assert envs.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    observation, _ = envs.reset(seed=0)
    assert observation in envs.observation_space
    observation, *_ = envs.step(envs.action_space.sample())
    assert observation in envs.observation_space
    envs.close()


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_environments_of_one_session_equal_separate_sessions(port: HttpSurrogate, mode: AutoresetMode):
    options = {"time_limit": 5, "deviations": True}
    together = RemoteVectorEnv(port, len(SEEDS), autoreset_mode=mode, **options)
    apart = SyncVectorEnv([lambda: RemoteEnv(port, **options)] * len(SEEDS), autoreset_mode=mode)
    assert data_equivalence(together.reset(seed=SEEDS), apart.reset(seed=SEEDS))
    for action in np.random.default_rng(0).uniform(-2, 2, (12, len(SEEDS), 1)).astype(np.float32):
        ours, theirs = together.step(action), apart.step(action)
        assert data_equivalence(ours, theirs), f"ours:\n{ours}\ntheirs:\n{theirs}"
    together.close()
    apart.close()


SETTINGS: dict[type[BaseAlgorithm], dict[str, int]] = {
    PPO: {"n_steps": 8, "batch_size": 32},
    A2C: {"n_steps": 8},
    SAC: {"learning_starts": 8, "batch_size": 8},
}


@pytest.mark.parametrize("algorithm", list(SETTINGS))
def test_stable_baselines3_algorithms_train_on_a_remote_environment(pendulum_server, algorithm: type[BaseAlgorithm]):
    envs = SurrogateVecEnv(pendulum_server.url, "pendulum", num_envs=4, time_limit=10)
    model = algorithm("MlpPolicy", envs, seed=0, device="cpu", **SETTINGS[algorithm])
    model.learn(total_timesteps=64)
    returns, lengths = evaluate_policy(model, envs, 4, return_episode_rewards=True, warn=False)
    assert lengths == [10] * 4
    assert np.isfinite(returns).all()
    envs.close()


def test_a_session_that_expired_on_the_server_is_replaced_by_a_new_one(port: HttpSurrogate):
    envs = SurrogateVecEnv.from_port(port, 2, seed=0)
    last, ended = envs.reset(), envs.session
    port.close(ended)
    observation, _, done, infos = envs.step(np.zeros((2, 1), dtype=np.float32))
    assert done.all()
    assert envs.session != ended
    assert all(ended in info[LOST] for info in infos)
    np.testing.assert_array_equal([info["terminal_observation"] for info in infos], last)
    assert not np.array_equal(observation, last)
    envs.close()
