"""The original environment behind the trainer's port: Gymnasium's own episodes, every step of them counted."""

from functools import partial

import gymnasium
import numpy as np
import pytest

from surrogym_client.sb3 import SurrogateVecEnv
from surrogym_lab.original_port import OriginalPort
from surrogym_sampler import original
from surrogym_sampler.original.episodes import GymnasiumEpisode, open_episode
from surrogym_shared.port import SurrogatePort
from surrogym_shared.wire import OpenSession
from surrogym_trainer.training import TrainSettings, train


def port_of(name: str) -> OriginalPort:
    spec = original.make(name).spec()
    return OriginalPort(spec, partial(open_episode, name, spec, partial(original.make, name)))


def test_the_original_environment_can_be_used_through_the_surrogate_interface():
    assert isinstance(port_of("Pendulum-v1"), SurrogatePort)


@pytest.mark.parametrize("name", ["Pendulum-v1", "CartPole-v1"])
def test_rewards_in_a_session_of_the_original_environment_equal_gymnasiums(name):
    port = port_of(name)
    env = SurrogateVecEnv.from_port(port, 2, seed=0)
    env.reset()
    native = gymnasium.make(name).unwrapped
    native.reset(seed=0)
    native.state = np.array(port._sessions[env.session][0].instance()._env.state)
    rng = np.random.default_rng(0)
    for _ in range(5):
        action = [env.action_space.sample() if name == "CartPole-v1" else rng.uniform(-2, 2, 1) for _ in range(2)]
        observation, reward, _, _ = env.step(np.array(action))
        expected, gained, _, _, _ = native.step(action[0])
        np.testing.assert_allclose(observation[0], expected, rtol=1e-5)
        assert reward[0] == pytest.approx(gained, rel=1e-5)
    assert port.steps == 10


def test_episodes_in_the_original_environment_terminate_or_truncate_and_restart():
    env = SurrogateVecEnv.from_port(port_of("CartPole-v1"), 3, seed=0, time_limit=12)
    env.reset()
    ended = []
    for _ in range(40):
        observation, _, done, infos = env.step(np.ones(3, dtype=int))
        ended += [
            (info["TimeLimit.truncated"], info["terminal_observation"])
            for info in infos
            if info.get("terminal_observation") is not None
        ]
        assert np.abs(observation[done]).max(initial=0) <= 0.05
    assert len(ended) > 6
    assert {truncated for truncated, _ in ended} <= {True, False}
    assert all(abs(final[2]) > 0.15 for truncated, final in ended if not truncated)


def test_starts_in_the_original_environment_are_reproducible_and_start_box_widens_them():
    starts = [SurrogateVecEnv.from_port(port_of("Pendulum-v1"), 200, seed=s, start_box=1.0).reset() for s in (0, 0, 1)]
    np.testing.assert_array_equal(starts[0], starts[1])
    assert (starts[0] != starts[2]).any()
    assert np.abs(starts[0][:, 2]).max() > 6


def test_training_in_the_original_environment_counts_every_real_step(tmp_path):
    name = "Pendulum-v1"
    spec = original.make(name).spec().model_copy(update={"time_limit": 5})
    taken = []

    class Counted(GymnasiumEpisode):
        def step(self, action):
            taken.append(action)
            return super().step(action)

    port = OriginalPort(spec, lambda: Counted(spec))
    quick = {"n_steps": 16, "batch_size": 32, "n_epochs": 1}
    result = train(
        port, tmp_path / "policy.zip", TrainSettings("PPO", total_steps=256, num_envs=4, hyperparameters=quick)
    )
    assert result.virtual_steps == 256
    assert port.steps == len(taken) > 256, "the checks of the policy are real steps too"
    assert (result.settings["n_steps"], result.settings["gae_lambda"]) == (16, 0.97)
    assert result.settings["net_arch"]


def test_training_in_the_original_environment_refuses_other_autoreset_modes_than_same_step():
    with pytest.raises(ValueError, match="got disabled"):
        port_of("Pendulum-v1").open(OpenSession(autoreset_mode="disabled"))


def test_resetting_a_closed_session_in_the_original_environment_is_refused():
    port = port_of("Pendulum-v1")
    name = port.open(OpenSession(autoreset_mode="same_step")).id
    port.close(name)
    port.close(name)
    with pytest.raises(ValueError, match="expected an open session"):
        port.reset(name)
