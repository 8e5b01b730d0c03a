"""Resets: the law of seeds, masks, the start distribution, the share of starts anywhere, and first particles."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import kstest

from surrogym_server.errors import InvalidInput
from surrogym_server.virtual import VirtualSettings, create, reset
from surrogym_shared.spec import Fixed, Normal


@pytest.fixture
def definition(pendulum_model):
    return pendulum_model.definition


def starts(definition, count, seed=None, first=0, episodes=1, **chosen):
    """Observations of so many episodes of fresh lanes: (episodes, count, D). The first reset is the seeded one."""
    settings = VirtualSettings(count, **chosen)
    lanes, made = create(definition, settings, first), []
    for episode in range(episodes):
        lanes, observation = reset(definition, settings, lanes, seed if episode == 0 else None)
        made.append(observation)
    return np.stack(made)


def test_one_seed_gives_each_environment_its_own_noise_key(definition):
    three, five = starts(definition, 3, seed=7), starts(definition, 5, seed=7)
    np.testing.assert_array_equal(three[0], five[0][:3])
    assert len(np.unique(five[0][:, 0])) == 5


def test_an_environment_with_its_own_seed_starts_as_in_a_session_of_its_own(definition):
    listed = starts(definition, 3, seed=[7, 8, 7])[0]
    for lane, seed in enumerate([7, 8, 7]):
        np.testing.assert_array_equal(listed[lane], starts(definition, 1, seed=seed)[0][0])


def test_a_reset_without_seed_starts_the_next_episode_of_the_first_seed(definition):
    first = starts(definition, 2, seed=7, episodes=3)
    assert len(np.unique(first[:, :, 0])) == 6
    np.testing.assert_array_equal(first, starts(definition, 2, seed=7, episodes=3))
    np.testing.assert_array_equal(first, starts(definition, 2, seed=None, first=7, episodes=3))


def test_resetting_with_seed_zero_differs_from_resetting_without_seed(definition):
    assert not np.array_equal(starts(definition, 2, seed=0, first=3), starts(definition, 2, seed=None, first=3))
    np.testing.assert_array_equal(starts(definition, 2, seed=0, first=3), starts(definition, 2, seed=0, first=4))


def test_a_masked_reset_keeps_the_other_environments(definition):
    settings = VirtualSettings(3)
    lanes, before = reset(definition, settings, create(definition, settings, 0))
    lanes, after = reset(definition, settings, lanes, seed=9, mask=np.array([False, True, False]))
    np.testing.assert_array_equal(after[[0, 2]], before[[0, 2]])
    np.testing.assert_array_equal(after[1], starts(definition, 3, seed=9)[0][1])
    assert lanes.seed.tolist() == [0, 9, 0]
    assert lanes.episode.tolist() == [0, 0, 0]


def test_a_reset_with_an_empty_mask_changes_nothing(definition):
    settings = VirtualSettings(2)
    fresh = create(definition, settings, 0)
    lanes, _ = reset(definition, settings, fresh, mask=np.zeros(2, dtype=bool))
    assert lanes.episode.tolist() == [-1, -1]


@pytest.mark.parametrize(("options", "complaint"), [({"mask": np.ones(3, bool)}, "mask"), ({"seed": [1]}, "seed")])
def test_reset_masks_and_seeds_of_wrong_length_are_refused(definition, options, complaint):
    settings = VirtualSettings(2)
    with pytest.raises(InvalidInput, match=f"{complaint}: expected"):
        reset(definition, settings, create(definition, settings, 0), **options)


def test_start_states_follow_the_declared_distribution(definition):
    declared = replace(definition, start=(Fixed(value=0.5), Normal(mean=1, std=2, low=-3, high=5)))
    observation = starts(declared, 2_000)[0]
    np.testing.assert_allclose(observation[:, 0], math.cos(0.5), atol=1e-6)
    assert observation[:, 2].min() >= -3
    assert observation[:, 2].mean() == pytest.approx(1, abs=0.15)
    uniform = starts(definition, 2_000)[0]
    assert kstest(uniform[:, 2], "uniform", args=(-1, 2)).pvalue > 0.01


def test_with_start_box_a_share_of_episodes_starts_anywhere_in_the_sampling_range(definition):
    assert np.abs(starts(definition, 500)[0][:, 2]).max() <= 1
    fast = np.abs(starts(definition, 4_000, start_box=0.5)[0][:, 2]) > 1
    assert fast.mean() == pytest.approx(0.5 * 7 / 8, abs=0.04)
    everywhere = starts(definition, 2_000, start_box=1.0)[0]
    assert kstest(everywhere[:, 2], "uniform", args=(-8, 16)).pvalue > 0.01


def test_particles_start_around_the_reset_state_with_the_given_spread(definition):
    settings = VirtualSettings(2, variant="probabilistic", particles=4_000, spread=0.01)
    lanes, observation = reset(definition, settings, create(definition, settings, 0))
    assert lanes.particles.shape == (2, 4_000, 2)
    np.testing.assert_allclose(observation, definition.observe(lanes.q).numpy(), atol=1e-6)
    off = lanes.particles - lanes.q[:, None]
    off[..., 0] = torch.remainder(off[..., 0] + math.pi, 2 * math.pi) - math.pi
    torch.testing.assert_close(off.std(1), torch.tensor([[0.02 * math.pi, 0.16]] * 2).double(), rtol=0.05, atol=0)
    torch.testing.assert_close(off.mean(1), torch.zeros(2, 2).double(), rtol=0, atol=0.01)


def test_initial_particles_keep_constant_coordinates_and_stay_within_bounds(definition):
    angle, speed = definition.coordinates
    constant = angle.model_copy(update={"kind": "constant"})
    fixed = replace(definition, coordinates=(constant, speed), start=(definition.start[0], Fixed(value=8.0)))
    settings = VirtualSettings(1, variant="probabilistic", particles=50, spread=0.2)
    lanes, _ = reset(fixed, settings, create(fixed, settings, 0))
    assert (lanes.particles[..., 0] == lanes.q[:, :1]).all()
    assert lanes.particles[..., 1].max() == 8
    assert lanes.particles[..., 1].min() < 8
