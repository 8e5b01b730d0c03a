"""Gymnasium's wrappers take a surrogate for one of its own environments: same results, and the same refusals."""

from collections.abc import Callable

import gymnasium
import numpy as np
import pytest
from gymnasium import wrappers
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv

from support.exact_pendulum import ExactEnv, ExactPendulum
from surrogym_client.environments import RemoteEnv, RemoteVectorEnv
from surrogym_client.registration import ENVIRONMENT_ID

LANES = 3
SEEDS = [5, 6, 7]
TIMES = ("t",)  # of an episode's statistics: seconds, which differ


def as_cleanrl(env: VectorEnv) -> VectorEnv:
    """The stack of CleanRL's PPO for continuous actions."""
    env = wrappers.vector.RecordEpisodeStatistics(env)
    env = wrappers.vector.ClipAction(env)
    env = wrappers.vector.NormalizeObservation(env)
    return wrappers.vector.NormalizeReward(env, gamma=0.98)


def without_times(infos: dict) -> dict:
    episode = {key: value for key, value in infos.get("episode", {}).items() if key.strip("_") not in TIMES}
    return infos | {"episode": episode}


@pytest.mark.parametrize(
    ("mode", "wrap"),
    [
        (AutoresetMode.NEXT_STEP, as_cleanrl),
        (AutoresetMode.SAME_STEP, wrappers.vector.RecordEpisodeStatistics),
        (AutoresetMode.SAME_STEP, wrappers.vector.NormalizeReward),
    ],
)
def test_gymnasiums_vector_wrappers_give_the_same_results_as_on_sync_vector_env(
    mode: AutoresetMode, wrap: Callable[[VectorEnv], VectorEnv]
):
    ours = wrap(RemoteVectorEnv(ExactPendulum(), LANES, autoreset_mode=mode))
    theirs = wrap(SyncVectorEnv([ExactEnv] * LANES, autoreset_mode=mode))
    assert data_equivalence(ours.reset(seed=SEEDS), theirs.reset(seed=SEEDS))
    for action in np.random.default_rng(1).uniform(-3, 3, (40, LANES, 1)).astype(np.float32):
        (*our, our_infos), (*their, their_infos) = ours.step(action), theirs.step(action)
        assert data_equivalence(our, their)
        assert data_equivalence(without_times(our_infos), without_times(their_infos))


def test_gymnasiums_normalize_wrapper_refuses_other_autoreset_modes_than_next_step():
    """Why the default is Gymnasium's: this wrapper refuses the modes that TorchRL's ``GymWrapper`` asks for."""
    for mode in (AutoresetMode.SAME_STEP, AutoresetMode.DISABLED):
        for envs in (
            RemoteVectorEnv(ExactPendulum(), 2, autoreset_mode=mode),
            SyncVectorEnv([ExactEnv] * 2, autoreset_mode=mode),
        ):
            with pytest.raises(ValueError, match="NEXT_STEP"):
                wrappers.vector.NormalizeObservation(envs)


@pytest.mark.parametrize(
    "wrap",
    [
        lambda env: wrappers.TimeLimit(env, 4),
        wrappers.NormalizeObservation,
        wrappers.NormalizeReward,
        wrappers.Autoreset,
        lambda env: wrappers.FrameStackObservation(env, 3),
        lambda env: wrappers.RescaleAction(env, np.float32(-1), np.float32(1)),
    ],
)
def test_gymnasiums_wrappers_give_the_same_results_as_on_the_local_environment(
    wrap: Callable[[gymnasium.Env], gymnasium.Env],
):
    ours, theirs = wrap(RemoteEnv(ExactPendulum())), wrap(ExactEnv())
    assert data_equivalence(ours.reset(seed=3), theirs.reset(seed=3))
    for action in np.random.default_rng(1).uniform(-1, 1, (20, 1)).astype(np.float32):
        our, their = ours.step(action), theirs.step(action)
        assert data_equivalence(our, their)
        if our[2] or our[3]:
            assert data_equivalence(ours.reset(), theirs.reset())


def test_record_video_without_a_render_mode_raises_gymnasiums_error(tmp_path):
    with pytest.raises(ValueError, match="Render mode is None"):
        wrappers.RecordVideo(RemoteEnv(ExactPendulum()), str(tmp_path))


@pytest.mark.parametrize("vectorization", ["sync", "async"])
def test_gymnasium_make_vec_can_combine_single_remote_environments(pendulum_server, vectorization: str):
    options = {"url": pendulum_server.url, "surrogate": "pendulum", "time_limit": 3}
    mode = {"autoreset_mode": AutoresetMode.SAME_STEP}
    envs = gymnasium.make_vec(ENVIRONMENT_ID, 2, vectorization_mode=vectorization, vector_kwargs=mode, **options)
    envs.reset(seed=0)
    truncated = [envs.step(envs.action_space.sample())[3].tolist() for _ in range(3)]
    assert truncated == [[False, False], [False, False], [True, True]]
    envs.close()
