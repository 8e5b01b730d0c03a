"""RemoteVectorEnv speaks Gymnasium's dialect: that of SyncVectorEnv on the same trajectory, infos too."""

import pickle

import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from support.exact_pendulum import ExactEnv, ExactPendulum
from surrogym_client.environments import RemoteVectorEnv
from surrogym_client.errors import NotReset

SEEDS = [5, 6, 7, 8]


def both(mode: AutoresetMode) -> tuple[RemoteVectorEnv, SyncVectorEnv]:
    remote = RemoteVectorEnv(ExactPendulum(), len(SEEDS), autoreset_mode=mode)
    return remote, SyncVectorEnv([ExactEnv] * len(SEEDS), autoreset_mode=mode)


def actions(steps: int) -> np.ndarray:
    return np.random.default_rng(1).uniform(-2, 2, (steps, len(SEEDS), 1)).astype(np.float32)


def assert_same(ours: object, theirs: object) -> None:
    assert data_equivalence(ours, theirs, exact=True), f"ours:\n{ours}\ntheirs:\n{theirs}"


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_the_vector_environment_autoresets_like_gymnasiums_sync_vector_env(mode: AutoresetMode):
    remote, reference = both(mode)
    assert_same(remote.reset(seed=SEEDS), reference.reset(seed=SEEDS))
    ended = np.zeros(2)
    for action in actions(60):
        ours, theirs = remote.step(action), reference.step(action)
        assert_same(ours, theirs)
        ended += [ours[2].sum(), ours[3].sum()]
    assert (ended > 3).all(), "expected several episodes to end either way"


def test_with_autoreset_disabled_a_masked_reset_equals_gymnasiums():
    remote, reference = both(AutoresetMode.DISABLED)
    assert_same(remote.reset(seed=SEEDS), reference.reset(seed=SEEDS))
    masks = 0
    for action in actions(60):
        ours, theirs = remote.step(action), reference.step(action)
        assert_same(ours, theirs)
        if (mask := ours[2] | ours[3]).any():
            ours = remote.reset(options={"reset_mask": mask})
            assert_same(ours, reference.reset(options={"reset_mask": mask.copy()}))
            masks += not mask.all()
    assert masks > 3, "expected several partial resets"


def test_with_autoreset_disabled_stepping_a_finished_environment_is_refused():
    remote, _ = both(AutoresetMode.DISABLED)
    remote.reset(seed=SEEDS)
    over = False
    while not over:
        _, _, terminated, truncated, _ = remote.step(actions(1)[0])
        over = (terminated | truncated).any()
    with pytest.raises(NotReset, match="has to be reset"):
        remote.step(actions(1)[0])


def test_a_list_of_reset_seeds_may_contain_none():
    remote, reference = both(AutoresetMode.NEXT_STEP)
    for seeds in (SEEDS, [None, 9, None, 10], [None] * 4):
        assert_same(remote.reset(seed=seeds), reference.reset(seed=seeds))


def test_seeds_of_a_masked_reset_reach_only_the_masked_environments():
    remote, reference = both(AutoresetMode.DISABLED)
    assert_same(remote.reset(seed=SEEDS), reference.reset(seed=SEEDS))
    first, second = actions(2)
    assert_same(remote.step(first), reference.step(first))
    mask = np.array([True, False, True, False])
    for seeds in ([9, 9, 9, 9], [None, 9, 3, None]):
        ours = remote.reset(seed=seeds, options={"reset_mask": mask})
        assert_same(ours, reference.reset(seed=seeds, options={"reset_mask": mask.copy()}))
    assert_same(remote.step(second), reference.step(second))


def test_a_list_of_reset_seeds_of_wrong_length_is_refused():
    for envs in both(AutoresetMode.NEXT_STEP):
        with pytest.raises(ValueError, match="seed"):
            envs.reset(seed=[1, 2])


def test_an_int_seed_repeats_and_an_unseeded_reset_continues():
    remote, _ = both(AutoresetMode.NEXT_STEP)
    first, second = remote.reset(seed=0)[0], remote.reset()[0]
    assert_same(remote.reset(seed=0)[0], first)
    assert_same(remote.reset()[0], second)
    assert not np.array_equal(first, second)
    assert len(np.unique(first, axis=0)) == len(SEEDS)


@pytest.mark.parametrize("mode", ["same_step", "SameStep", AutoresetMode.SAME_STEP])
def test_any_form_of_the_autoreset_mode_becomes_gymnasiums_enum(mode: object):
    envs = RemoteVectorEnv(ExactPendulum(), 2, autoreset_mode=mode)
    assert envs.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP


def test_an_unknown_autoreset_mode_is_refused():
    with pytest.raises(ValueError, match=r"expected one of .*same_step.*, got 'sometimes'"):
        RemoteVectorEnv(ExactPendulum(), 2, autoreset_mode="sometimes")


def test_the_time_limit_may_be_given_as_max_episode_steps():
    """``gymnasium.make_vec`` hands ``max_episode_steps`` to a vector environment, which has no wrapper for it."""
    envs = RemoteVectorEnv(ExactPendulum(), 2, max_episode_steps=3)
    envs.reset(seed=0)
    assert [envs.step(actions(1)[0][:2])[3].tolist() for _ in range(3)] == [[False] * 2, [False] * 2, [True] * 2]


def test_giving_both_time_limit_and_max_episode_steps_is_refused():
    with pytest.raises(
        ValueError, match="expected either time_limit or max_episode_steps, which mean the same, got both"
    ):
        RemoteVectorEnv(ExactPendulum(), 2, max_episode_steps=3, time_limit=4)


@pytest.mark.parametrize(
    ("mask", "error"),
    [
        ([True, False, False, False], TypeError),
        (np.array([1, 0, 0, 0]), TypeError),
        (np.array([True, False]), ValueError),
        (np.zeros(4, dtype=bool), ValueError),
    ],
)
def test_an_invalid_reset_mask_is_refused_like_in_gymnasium(mask: object, error: type[Exception]):
    for envs in both(AutoresetMode.DISABLED):
        envs.reset(seed=SEEDS)
        with pytest.raises(error):
            envs.reset(options={"reset_mask": mask})


def test_predictive_deviations_are_in_the_vector_infos_on_request():
    envs = RemoteVectorEnv(ExactPendulum(), 2, deviations=True)
    envs.reset(seed=0)
    infos = envs.step(np.zeros((2, 1), dtype=np.float32))[-1]
    assert infos["deviation"].shape == (2, 3)
    assert infos["_deviation"].all()


def test_the_vector_environment_shares_no_memory_with_returned_arrays():
    envs, untouched = both(AutoresetMode.NEXT_STEP)
    untouched.reset(seed=SEEDS)
    envs.reset(seed=SEEDS)[0][:] = np.nan
    for action in actions(20):
        observation, *_ = envs.step(action)
        assert_same(observation, untouched.step(action)[0])
        observation[:] = np.nan


def test_a_pickled_vector_environment_continues():
    envs, reference = both(AutoresetMode.NEXT_STEP)
    envs.reset(seed=SEEDS)
    reference.reset(seed=SEEDS)
    again = pickle.loads(pickle.dumps(envs))
    for action in actions(3):
        assert_same(again.step(action), reference.step(action))


def test_closing_the_vector_environment_twice_ends_its_session_once():
    port = ExactPendulum()
    envs = RemoteVectorEnv(port, 2)
    envs.close()
    envs.close()
    assert not port.sessions


def test_the_length_of_a_vector_environment_is_its_number_of_environments():
    assert len(RemoteVectorEnv(ExactPendulum(), 3)) == 3
