"""The classic control adapters say the truth about Gymnasium's own environments."""

import gymnasium
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surrogym_sampler import original
from surrogym_sampler.original.classic import TASKS
from surrogym_sampler.original.gymnasium import native_action, wrapped
from surrogym_shared import terms
from surrogym_shared.spec import limits

IDS = tuple(TASKS)


@pytest.fixture(scope="module")
def environments():
    made = {name: original.make(name) for name in IDS}
    yield made
    for environment in made.values():
        environment.close()


def random_places(spec, seed, n):
    rng = np.random.default_rng(seed)
    boxes = np.array([limits(c.sampling) for c in spec.coordinates])
    return rng.uniform(boxes[:, 0], boxes[:, 1], (n, len(boxes)))


def random_action(spec, rng):
    if spec.action.kind == "box":
        return rng.uniform(spec.action.low, spec.action.high)
    return np.array([float(rng.integers(spec.action.n))])


def turned(spec, difference):
    """The difference of coordinates, with angles taken the short way round."""
    angles = [c.kind == "angle" for c in spec.coordinates]
    return np.where(angles, (difference + np.pi) % (2 * np.pi) - np.pi, difference)


def test_wrapping_many_states_at_once_equals_wrapping_each(environments):
    """An angle's column, and not the row of the same number: descriptions of rewards read many steps at once."""
    spec = environments["Pendulum-v1"].spec()
    rows = np.random.default_rng(0).uniform(-8, 8, (5, len(spec.coordinates)))
    np.testing.assert_array_equal(wrapped(spec, rows), [wrapped(spec, row) for row in rows])


@pytest.mark.parametrize("name", IDS)
def test_step_from_reproduces_the_classic_environments_trajectory(environments, name):
    environment = environments[name]
    spec = environment.spec()
    real = gymnasium.make(name).unwrapped
    real.reset(seed=3)
    rng = np.random.default_rng(0)
    for _ in range(60):
        before = wrapped(spec, np.array(real.state, dtype=float))
        action = random_action(spec, rng)
        observation, reward, terminated, _, _ = real.step(native_action(spec.action, action))
        step = environment.step_from(before, action)
        after = wrapped(spec, np.array(real.state, dtype=float))
        np.testing.assert_allclose(turned(spec, step.next_coordinates - after), 0, atol=1e-6)
        np.testing.assert_allclose(step.next_observation, observation, atol=1e-6)
        np.testing.assert_allclose(step.coordinates, before, atol=1e-12)
        assert step.reward == pytest.approx(reward, abs=1e-6)
        assert step.terminated == terminated
        if terminated:
            break


@pytest.mark.parametrize("name", IDS)
@given(seed=st.integers(0, 10_000))
@settings(max_examples=30)
def test_declared_observation_and_termination_equal_those_of_gymnasium(environments, name, seed):
    environment = environments[name]
    spec = environment.spec()
    rng = np.random.default_rng(seed)
    place = random_places(spec, seed, 1)[0]
    step = environment.step_from(place, random_action(spec, rng))
    after = np.array([step.next_coordinates])
    np.testing.assert_allclose(terms.observe(spec, after)[0], step.next_observation, atol=2e-6)
    assert terms.terminates(spec, after)[0] == step.terminated


@pytest.mark.parametrize("name", IDS)
def test_step_from_does_not_depend_on_earlier_steps(environments, name):
    """A counter left from an earlier episode would change the reward, or warn."""
    environment = environments[name]
    spec = environment.spec()
    places = random_places(spec, 1, 40)
    rng = np.random.default_rng(1)
    actions = [random_action(spec, rng) for _ in places]
    there = [environment.step_from(q, u) for q, u in zip(places, actions, strict=True)]
    back = [environment.step_from(q, u) for q, u in zip(places[::-1], actions[::-1], strict=True)][::-1]
    for first, second in zip(there, back, strict=True):
        assert first.reward == second.reward
        np.testing.assert_array_equal(first.next_coordinates, second.next_coordinates)


@pytest.mark.parametrize("name", IDS)
def test_the_declared_spaces_equal_those_of_gymnasium(environments, name):
    spec = environments[name].spec()
    env = gymnasium.make(name)
    assert spec.time_limit == env.spec.max_episode_steps
    lows = [-np.inf if o.low is None else o.low for o in spec.observation]
    highs = [np.inf if o.high is None else o.high for o in spec.observation]
    np.testing.assert_allclose(lows, env.observation_space.low, rtol=1e-6)
    np.testing.assert_allclose(highs, env.observation_space.high, rtol=1e-6)
    if spec.action.kind == "box":
        np.testing.assert_allclose(spec.action.low, env.action_space.low)
        np.testing.assert_allclose(spec.action.high, env.action_space.high)
    else:
        assert spec.action.n == env.action_space.n


@pytest.mark.parametrize("name", IDS)
def test_the_declared_start_range_contains_gymnasiums_resets(environments, name):
    spec = environments[name].spec()
    env = gymnasium.make(name).unwrapped
    for seed in range(50):
        env.reset(seed=seed)
        for value, coordinate in zip(env.state, spec.coordinates, strict=True):
            low, high = limits(spec.start[coordinate.name])
            assert low - 1e-7 <= value <= high + 1e-7


def test_the_terminating_step_of_cart_pole_is_rewarded_as_in_gymnasium(environments):
    step = environments["CartPole-v1"].step_from(np.array([0, 0, 0.209, 3.0]), np.array([1.0]))
    assert step.terminated
    assert step.reward == 1.0


def test_cart_pole_of_preset_paper_pays_0_outside_and_never_terminates():
    environment = original.make("CartPole-v1", preset="paper")
    assert environment.spec().design.preset == "paper"
    assert environment.spec().time_limit == 200
    outside = environment.step_from(np.array([3.0, 0, 0, 0]), np.array([1.0]))
    inside = environment.step_from(np.array([0.0, 0, 0, 0]), np.array([1.0]))
    assert (outside.reward, outside.terminated) == (0.0, False)
    assert (inside.reward, inside.terminated) == (1.0, False)


def test_mountain_car_hits_the_wall_and_stays_within_its_bounds(environments):
    step = environments["MountainCarContinuous-v0"].step_from(np.array([-1.19, -0.06]), np.array([-1.0]))
    assert step.next_coordinates.tolist() == [-1.2, 0.0]
