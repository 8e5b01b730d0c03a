"""Variant pathwise: a lane follows one function through an episode, drawn anew for the next, by its key alone."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from support.exact_models import ExactModel, exact_pendulum
from support.models import learn
from support.real_steps import random_steps
from surrogym_sampler.original.classic import pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.samples import Samples
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.virtual import LaneState, paths, step

ARRAYS = ("observation", "reward", "terminated", "truncated")


@pytest.fixture(scope="module")
def samples() -> Samples:
    """So few that the model is unsure."""
    return random_steps(pendulum(), 7, seed=3)


@pytest.fixture(scope="module")
def model(samples: Samples) -> GaussianProcessModel:
    return learn(definition_from_spec(pendulum()), samples).model


@pytest.fixture(scope="module")
def better() -> GaussianProcessModel:
    return learn(definition_from_spec(pendulum()), random_steps(pendulum(), 12, seed=3)).model


def at(lanes: LaneState, *q: float) -> LaneState:
    return replace(lanes, q=torch.tensor(q, dtype=torch.float64).expand(len(lanes), -1).clone())


def moved(model, settings, lanes, *q: float, action: float = 0.5) -> tuple[LaneState, np.ndarray]:
    """The lanes after a step from one point, and where they went."""
    after, _ = step(model, settings, at(lanes, *q), np.full((len(lanes), 1), action))
    return after, after.q.numpy()


def test_in_pathwise_mode_a_state_has_the_same_step_throughout_an_episode(model, started):
    settings, lanes = started(model, 3, variant="pathwise")
    lanes, first = moved(model, settings, lanes, 2.0, -6.0)
    lanes, elsewhere = moved(model, settings, lanes, -1.0, 5.0)
    lanes, again = moved(model, settings, lanes, 2.0, -6.0)
    np.testing.assert_array_equal(first, again)
    assert len(np.unique(first[:, 1])) == 3, "each lane has a function of its own"
    assert not np.allclose(elsewhere, first)


def test_functions_sampled_in_several_blocks_are_those_of_one_block(model, started, monkeypatch):
    _, whole = moved(model, *started(model, 5, variant="pathwise"), 2.0, -6.0)
    monkeypatch.setattr(paths, "BLOCK", 2)
    _, split = moved(model, *started(model, 5, variant="pathwise"), 2.0, -6.0)
    np.testing.assert_allclose(split, whole, rtol=1e-12)


def test_with_functions_2_pathwise_environments_share_two_drawn_functions(model, started):
    settings, lanes = started(model, 6, variant="pathwise", functions=2)
    assert len(np.unique(lanes.q.numpy(), axis=0)) == 6
    _, there = moved(model, settings, lanes, 2.0, -6.0)
    assert len(np.unique(there[:, 1])) == 2
    np.testing.assert_array_equal(there[:2], there[2:4])


def test_a_step_with_shared_functions_may_begin_an_episode_in_every_environment(model, started):
    settings, lanes = started(model, 2, variant="pathwise", functions=2, time_limit=1)
    for _ in range(2):
        lanes, _ = moved(model, settings, lanes, 2.0, -6.0)
    assert lanes.episode.tolist() == [1, 1]


def test_the_next_pathwise_episode_follows_another_drawn_function(model, started):
    settings, lanes = started(model, 2, variant="pathwise", time_limit=1, autoreset_mode="same_step")
    lanes, _ = moved(model, settings, lanes, 2.0, -6.0)
    assert (lanes.elapsed == 0).all()
    before = lanes.path
    lanes, _ = moved(model, settings, lanes, 2.0, -6.0)
    assert not np.isclose(before, lanes.path).any(1).all()


def test_pathwise_environments_vary_with_posterior_mean_and_deviation(model, started):
    """Mean and deviation of 2,000 lanes' steps; the deviation's tolerance has the 256 frequencies' share in it. The
    angle is moved by the speed that was drawn, over a step of 0.05 s, and scatters with it."""
    count, point = 2_000, (0.5, 3.0)
    settings, lanes = started(model, count, variant="pathwise")
    _, q = moved(model, settings, lanes, *point)
    one = torch.tensor([point], dtype=torch.float64)
    expected = model.transition(one, torch.full((1, 1), 0.5, dtype=torch.float64), stds=True)
    mean, (angle, speed) = expected.q_next[0].numpy(), expected.std[0].tolist()
    std = np.array([np.hypot(angle, 0.05 * speed), speed])
    assert (np.abs(q.mean(0) - mean) < 5 * std / np.sqrt(count)).all()
    np.testing.assert_allclose(q.std(0), std, rtol=0.25)


def test_pathwise_functions_pass_through_the_samples(model, samples, started):
    settings, lanes = started(model, 4, variant="pathwise")
    for q, u, q_next in zip(samples.q, samples.u, samples.q_next, strict=True):
        if float(q_next[1].abs()) < 8:  # one that ended at the bound is left out of the dynamics
            lanes, reached = moved(model, settings, lanes, *q.tolist(), action=float(u))
            np.testing.assert_allclose(reached, q_next.expand(4, -1), atol=1e-2)


def test_pathwise_episodes_are_reproducible_from_the_seed(model, started):
    runs = []
    for _ in range(2):
        settings, lanes = started(model, 5, variant="pathwise", time_limit=3)
        made = []
        for action in np.random.default_rng(0).uniform(-2, 2, (9, 5, 1)):
            lanes, transition = step(model, settings, lanes, action)
            made.append(transition)
        runs.append(made)
    for ours, theirs in zip(*runs, strict=True):
        for name in ARRAYS:
            np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))


def test_a_pathwise_function_does_not_depend_on_the_number_of_environments(model, started):
    few, many = (moved(model, *started(model, n, variant="pathwise"), 2.0, -6.0)[1] for n in (2, 9))
    np.testing.assert_allclose(few, many[:2], rtol=1e-9)


def test_pathwise_functions_are_unchanged_if_other_environments_use_a_larger_model(model, better, started):
    """A newer model has more points: its lanes' functions are longer, the others' still the same."""
    settings, lanes = started(model, 4, variant="pathwise")
    old, reached = moved(model, settings, lanes, 2.0, -6.0)
    newer, _ = moved(better, settings, lanes.take(np.array([1, 3])), 2.0, -6.0)
    assert newer.path.shape[1] > old.path.shape[1]
    both = old.put(np.array([1, 3]), newer)
    _, again = moved(model, settings, both.take(np.array([0, 2])), 2.0, -6.0)
    np.testing.assert_allclose(again, reached[[0, 2]], rtol=1e-9)


def test_the_pathwise_reward_follows_a_drawn_function(model, started):
    settings, lanes = started(model, 50, variant="pathwise")
    _, transition = step(model, settings, at(lanes, 2.0, -6.0), np.full((50, 1), 0.5))
    assert transition.reward.std() > 0
    np.testing.assert_array_equal(transition.reward, transition.reward_mean)


def test_if_a_model_has_no_drawn_functions_pathwise_episodes_have_one_constant_error_each(started):
    """Each lane lies the same number of deviations from the mean at every step, another in each episode."""
    exact = exact_pendulum()
    model = ExactModel(exact.definition, lambda q, _: q.clone(), exact.pay, std=0.01)
    settings, lanes = started(model, 3, variant="pathwise", autoreset_mode="same_step", time_limit=4)
    moved = [lanes.q[:, 1]]
    for _ in range(8):
        lanes, _ = step(model, settings, lanes, np.zeros((3, 1)))
        moved.append(lanes.q[:, 1])
    change = torch.stack(moved).diff(dim=0)
    torch.testing.assert_close(change[1:3], change[:1].expand(2, -1))
    assert bool((change[0].abs() > 0).all())
    assert not torch.allclose(change[4], change[0])
