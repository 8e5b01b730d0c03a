"""RemoteEnv is a Gymnasium environment that loses no information of the surrogate."""

import pickle
from collections.abc import Callable

import gymnasium
import numpy as np
import pytest

from support.exact_pendulum import ExactEnv, ExactPendulum
from surrogym_client.environments import RemoteEnv, RemoteVectorEnv
from surrogym_client.errors import NotReset
from surrogym_client.sb3 import SurrogateVecEnv

ACTION = np.array([0.5], dtype=np.float32)


def test_the_remote_environment_gives_the_same_trajectory_as_the_local_one():
    remote, reference = RemoteEnv(ExactPendulum()), ExactEnv()
    for seed in (3, None, None):
        (ours, info), (theirs, expected) = remote.reset(seed=seed), reference.reset(seed=seed)
        np.testing.assert_array_equal(ours, theirs)
        assert info == expected
        over = False
        while not over:
            ours, theirs = remote.step(ACTION), reference.step(ACTION)
            np.testing.assert_array_equal(ours[0], theirs[0])
            assert ours[1:] == theirs[1:]
            over = ours[2] or ours[3]


def test_the_remote_environment_returns_gymnasiums_value_types():
    env = RemoteEnv(ExactPendulum())
    observation, _ = env.reset(seed=0)
    assert observation in env.observation_space
    observation, reward, terminated, truncated, _ = env.step(ACTION)
    assert observation in env.observation_space
    assert (type(reward), type(terminated), type(truncated)) == (float, bool, bool)


def test_resetting_the_remote_environment_with_seed_zero_is_reproducible():
    env = RemoteEnv(ExactPendulum())
    first, _ = env.reset(seed=0)
    env.reset()
    np.testing.assert_array_equal(env.reset(seed=0)[0], first)


def test_a_step_after_the_end_of_an_episode_is_refused():
    env = RemoteEnv(ExactPendulum(), time_limit=1)
    env.reset(seed=0)
    env.step(ACTION)
    with pytest.raises(NotReset):
        env.step(ACTION)


def test_keyword_options_of_the_remote_environment_reach_its_session():
    port = ExactPendulum()
    RemoteEnv(port, variant="probabilistic", seed=4, penalty=1.5)
    request = port.opened[0]
    assert (request.variant, request.seed, request.penalty, request.num_envs) == ("probabilistic", 4, 1.5, 1)
    assert request.autoreset_mode == "disabled"


def test_the_error_for_an_out_of_range_option_names_it():
    with pytest.raises(ValueError, match=r"session options: penalty: .*got -1"):
        RemoteEnv(ExactPendulum(), penalty=-1.0)


@pytest.mark.parametrize("kind", [RemoteEnv, RemoteVectorEnv, SurrogateVecEnv.from_port])
@pytest.mark.parametrize("name", ["varaint", "frameskip", "num_lanes"])
def test_an_unknown_keyword_of_the_remote_environment_raises_type_error(kind: Callable[..., object], name: str):
    """Trainers try keywords and take back those refused like this: TorchRL's ``GymEnv`` tries ``frameskip``."""
    port = ExactPendulum()
    with pytest.raises(TypeError, match=rf"got an unexpected keyword argument '{name}'.*variant, seed"):
        kind(port, **{name: 1})
    assert port.opened == []


def test_the_error_for_a_removed_session_option_names_its_replacement():
    with pytest.raises(TypeError, match=r"argument 'caution'.*'caution' was removed: use penalty"):
        RemoteEnv(ExactPendulum(), caution=1.0)


def test_the_single_remote_environment_takes_no_autoreset_mode():
    with pytest.raises(TypeError, match="unexpected keyword argument 'autoreset_mode'"):
        RemoteEnv(ExactPendulum(), autoreset_mode="same_step")


def test_a_remote_environment_with_render_mode_human_is_refused():
    with pytest.raises(ValueError, match=r"expected render_mode.*'human'"):
        RemoteEnv(ExactPendulum(), render_mode="human")


def test_the_predictive_deviation_is_in_the_infos_on_request():
    env = RemoteEnv(ExactPendulum(), deviations=True)
    env.reset(seed=0)
    assert env.step(ACTION)[-1]["deviation"].shape == (3,)


def test_a_pickled_remote_environment_continues():
    env = RemoteEnv(ExactPendulum())
    env.reset(seed=1)
    again = pickle.loads(pickle.dumps(env))
    np.testing.assert_array_equal(again.step(ACTION)[0], env.step(ACTION)[0])


def test_closing_the_remote_environment_ends_its_session():
    port = ExactPendulum()
    with RemoteEnv(port) as env:
        assert isinstance(env, gymnasium.Env)
        assert port.sessions
    assert not port.sessions
