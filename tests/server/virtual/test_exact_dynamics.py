"""Fed by exact dynamics, the virtual environment is Gymnasium's own, step for step, in all three autoreset modes."""

from dataclasses import replace

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.envs.classic_control import CartPoleEnv
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from surrogym_server.errors import InvalidInput, NotReset
from surrogym_server.virtual import LaneState, VirtualSettings, create, reset, step
from surrogym_server.virtual.start import start_coordinates

LANES, TIME_LIMIT, SEED = 5, 25, 3
MODES = {
    "next_step": AutoresetMode.NEXT_STEP,
    "same_step": AutoresetMode.SAME_STEP,
    "disabled": AutoresetMode.DISABLED,
}


def test_the_virtual_pendulum_with_exact_dynamics_equals_gymnasiums_for_200_steps(pendulum_model, started):
    settings, lanes = started(pendulum_model, 3, time_limit=200)
    originals = [gymnasium.make("Pendulum-v1") for _ in range(3)]
    for original, q in zip(originals, lanes.q, strict=True):
        original.reset(seed=0)
        original.unwrapped.state = q.numpy().copy()
    for action in np.random.default_rng(0).uniform(-2, 2, (200, 3, 1)):
        lanes, made = step(pendulum_model, settings, lanes, action)
        for i, original in enumerate(originals):
            observation, reward, terminated, truncated, _ = original.step(action[i])
            np.testing.assert_allclose(made.observation[i], observation, atol=1e-5)
            assert made.reward[i] == pytest.approx(reward, abs=1e-5)
            assert (made.terminated[i], made.truncated[i]) == (terminated, truncated)
    assert made.truncated.all(), "the time limit is a truncation"
    assert not made.terminated.any()


class StartsOfALane(CartPoleEnv):
    """Gymnasium's CartPole, with the starts of one lane."""

    def __init__(self, definition, lane: int) -> None:
        super().__init__()
        self.lane = create(definition, VirtualSettings(LANES), SEED).take(np.array([lane]))
        self.definition = definition

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.lane = replace(self.lane, episode=self.lane.episode + 1)
        self.state = start_coordinates(self.definition, self.lane, 0.0)[0].numpy()
        return np.array(self.state, dtype=np.float32), {}


@pytest.fixture
def reference(cartpole_model):
    def make(mode: str) -> SyncVectorEnv:
        def lane(number: int):
            return lambda: gymnasium.wrappers.TimeLimit(StartsOfALane(cartpole_model.definition, number), TIME_LIMIT)

        return SyncVectorEnv([lane(i) for i in range(LANES)], autoreset_mode=MODES[mode])

    return make


@pytest.mark.parametrize("mode", MODES)
def test_virtual_environments_equal_gymnasiums_sync_vector_env_in_every_autoreset_mode(
    cartpole_model, started, reference, mode
):
    settings, lanes = started(cartpole_model, LANES, SEED, autoreset_mode=mode, time_limit=TIME_LIMIT)
    envs = reference(mode)
    theirs, _ = envs.reset()
    np.testing.assert_allclose(cartpole_model.definition.observe(lanes.q).numpy(), theirs, atol=1e-6)
    terminations = truncations = 0
    for action in np.random.default_rng(1).integers(0, 2, (200, LANES)):
        lanes, made = step(cartpole_model, settings, lanes, action[:, None].astype(float))
        theirs, reward, terminated, truncated, infos = envs.step(action)
        np.testing.assert_allclose(made.observation, theirs, atol=1e-5)
        np.testing.assert_array_equal(made.reward, reward)
        np.testing.assert_array_equal(made.terminated, terminated)
        np.testing.assert_array_equal(made.truncated, truncated)
        over = terminated | truncated
        if mode == "same_step":
            np.testing.assert_array_equal(made.final_lanes, np.flatnonzero(over))
            np.testing.assert_array_equal(made.reset_lanes, over)
            for lane, final in zip(made.final_lanes, made.final_observation, strict=True):
                np.testing.assert_allclose(final, infos["final_obs"][lane], atol=1e-5)
        elif mode == "disabled" and over.any():
            assert not made.reset_lanes.any()
            lanes, ours = reset(cartpole_model.definition, settings, lanes, mask=over)
            np.testing.assert_allclose(ours, envs.reset(options={"reset_mask": over})[0], atol=1e-5)
        terminations, truncations = terminations + terminated.sum(), truncations + truncated.sum()
    assert terminations > 10
    assert truncations > 5


def test_in_autoreset_mode_next_step_the_step_after_an_episode_end_only_resets(cartpole_model, started):
    settings, lanes = started(cartpole_model, 2, time_limit=1)
    lanes, ended = step(cartpole_model, settings, lanes, np.ones((2, 1)))
    assert ended.truncated.all()
    assert ended.reward.tolist() == [1.0, 1.0]
    lanes, begun = step(cartpole_model, settings, lanes, np.ones((2, 1)), stds=True)
    assert begun.reset_lanes.all()
    assert begun.reward.tolist() == [0.0, 0.0]
    assert not (begun.terminated | begun.truncated).any()
    assert begun.std.shape == (2, 5)
    assert lanes.episode.tolist() == [1, 1]
    assert lanes.elapsed.tolist() == [0, 0]


def test_a_step_at_the_time_limit_can_be_terminated_and_truncated(cartpole_model, started):
    settings, lanes = started(cartpole_model, 1, time_limit=1)
    falling = replace(lanes, q=torch.tensor([[0.0, 0.0, 0.2, 2.0]]).double())
    _, made = step(cartpole_model, settings, falling, np.ones((1, 1)))
    assert made.terminated.tolist() == [True]
    assert made.truncated.tolist() == [True]


@pytest.mark.parametrize(
    ("q", "over"),
    [
        ([2.39, 1.0, 0, 0], True),
        ([2.37, 1.0, 0, 0], False),
        ([-2.39, -1.0, 0, 0], True),
        ([0, 0, 0.2, 1.0], True),
        ([0, 0, -0.2, -1.0], True),
        ([0, 0, 0.2, 0.1], False),
    ],
)
def test_virtual_cart_pole_terminates_exactly_outside_its_limits(cartpole_model, started, q, over):
    settings, lanes = started(cartpole_model, 1)
    _, made = step(cartpole_model, settings, replace(lanes, q=torch.tensor([q]).double()), np.zeros((1, 1)))
    assert made.terminated.tolist() == [over]
    assert made.truncated.tolist() == [False]


def test_without_a_time_limit_virtual_episodes_are_never_truncated(pendulum_model, started):
    settings, lanes = started(pendulum_model, 1, time_limit=None)
    for _ in range(300):
        lanes, made = step(pendulum_model, settings, lanes, np.zeros((1, 1)))
        assert not made.truncated.any()


def test_a_masked_step_moves_only_the_masked_virtual_environments(pendulum_model, started):
    settings, lanes = started(pendulum_model, 3)
    mask, u = np.array([True, False, True]), np.array([[1.0], [2.0], [-1.0]])
    some, masked = step(pendulum_model, settings, lanes, u, mask)
    everyone, whole = step(pendulum_model, settings, lanes, u)
    np.testing.assert_array_equal(masked.observation[mask], whole.observation[mask])
    np.testing.assert_allclose(masked.observation[1], pendulum_model.definition.observe(lanes.q)[1], atol=1e-6)
    assert masked.reward[1] == masked.reward_mean[1] == 0
    assert some.elapsed.tolist() == [1, 0, 1]
    torch.testing.assert_close(some.q[[0, 2]], everyone.q[[0, 2]], rtol=0, atol=0)
    with pytest.raises(InvalidInput, match=r"expected 3 entries.* got 2"):
        step(pendulum_model, settings, lanes, u, np.ones(2, bool))


@pytest.mark.parametrize("mode", MODES)
def test_a_virtual_step_before_the_first_reset_is_refused(pendulum_model, mode):
    settings = VirtualSettings(2, autoreset_mode=mode)
    lanes = create(pendulum_model.definition, settings, 0)
    with pytest.raises(NotReset, match=r"lanes \[0, 1\]"):
        step(pendulum_model, settings, lanes, np.zeros((2, 1)))
    lanes, _ = reset(pendulum_model.definition, settings, lanes, mask=np.array([True, False]))
    with pytest.raises(NotReset, match=r"lanes \[1\]"):
        step(pendulum_model, settings, lanes, np.zeros((2, 1)))
    step(pendulum_model, settings, lanes, np.zeros((2, 1)), np.array([True, False]))


def test_stepping_a_finished_environment_with_autoreset_disabled_is_refused(pendulum_model, started):
    settings, lanes = started(pendulum_model, 2, autoreset_mode="disabled", time_limit=1)
    lanes, _ = step(pendulum_model, settings, lanes, np.zeros((2, 1)), np.array([False, True]))
    with pytest.raises(NotReset, match=r"lanes \[1\]"):
        step(pendulum_model, settings, lanes, np.zeros((2, 1)))


def test_a_virtual_step_does_not_modify_its_input_state(cartpole_model, started):
    settings, lanes = started(cartpole_model, 3, autoreset_mode="same_step", time_limit=2)
    before = {name: array.copy() for name, array in lanes.to_arrays().items()}
    after = lanes
    for _ in range(3):
        after, _ = step(cartpole_model, settings, after, np.ones((3, 1)))
    for name, array in lanes.to_arrays().items():
        np.testing.assert_array_equal(array, before[name])


def test_virtual_environments_restored_from_arrays_continue_equally(pendulum_model, started):
    settings, lanes = started(pendulum_model, 3, variant="probabilistic", particles=4)
    stored = {name: array.copy() for name, array in lanes.to_arrays().items()}
    loaded = LaneState.from_arrays(stored)
    for a, b in zip(
        *(step(pendulum_model, settings, s, np.ones((3, 1)))[0].to_arrays().values() for s in (lanes, loaded)),
        strict=True,
    ):
        np.testing.assert_array_equal(a, b)


def test_states_of_virtual_environments_can_be_selected_and_replaced_by_index_or_mask(pendulum_model, started):
    _, lanes = started(pendulum_model, 4)
    order = np.array([2, 0])
    taken = lanes.take(order)
    assert len(taken) == 2
    assert taken.lane.tolist() == [2, 0]
    moved = replace(taken, elapsed=np.array([7, 8]))
    assert lanes.put(order, moved).elapsed.tolist() == [8, 0, 7, 0]
    assert lanes.elapsed.tolist() == [0, 0, 0, 0]
    mask = np.array([False, True, False, True])
    again = lanes.put(mask, lanes.take(mask))
    for ours, theirs in zip(again.to_arrays().values(), lanes.to_arrays().values(), strict=True):
        np.testing.assert_array_equal(ours, theirs)
