"""Peers see the coordinates behind an observation, controls reach the environment as its actions, and steps count."""

import numpy as np
import pytest

from surrogym_lab.peers.methods.states import Held, States, episode, random_control
from surrogym_lab.peers.methods.told import TOLD, told
from surrogym_lab.peers.port import BudgetSpent, Clock, NotApplicable, OutOfTime, Real
from surrogym_sampler.original import make
from surrogym_sampler.original.episodes import open_episode
from surrogym_shared.terms import observe

NAMES = sorted(TOLD)


def real_of(name, budget=1_000, seconds=60.0):
    spec = make(name).spec()
    return Real(spec, lambda: open_episode(name, spec, lambda: make(name)), 0, budget, Clock(seconds))


@pytest.mark.parametrize("name", NAMES)
def test_compared_methods_recover_the_coordinates_from_observations(name):
    states = States(make(name).spec())
    q = np.random.default_rng(0).uniform(-1, 1, (5, len(states.angles)))
    np.testing.assert_allclose(states.coordinates(observe(states.spec, q)), q, atol=1e-9)
    assert states.featured(q).shape == (5, states.features)


@pytest.mark.parametrize("name", NAMES)
def test_the_reward_formula_given_to_compared_methods_equals_the_environments_reward(name):
    real, states = real_of(name), States(make(name).spec())
    rng, moment = np.random.default_rng(1), real.reset()
    for _ in range(20):
        u = states.snapped(rng.uniform(-1, 1, (1, states.controls)))
        after = real.step(states.native(u)[0])
        paid = told(real.spec).reward(moment.coordinates[None], u, after.coordinates[None])
        assert paid[0] == pytest.approx(after.reward, abs=1e-6)
        moment = real.reset() if after.terminated else after


def test_angle_changes_for_compared_methods_take_the_shorter_direction():
    states = States(make("Pendulum-v1").spec())
    change = states.change(np.array([[3.0, 5.0]]), np.array([[-3.0, -5.0]]))
    np.testing.assert_allclose(change, [[2 * np.pi - 6, -10.0]])


@pytest.mark.parametrize(("u", "snapped", "native"), [(-0.4, -1, 0), (0.2, 1, 1), (3.0, 1, 1)])
def test_continuous_controls_are_rounded_to_the_nearest_discrete_action(u, snapped, native):
    states = States(make("CartPole-v1").spec())
    assert states.snapped(np.array([[u]])).item() == snapped
    assert states.native(np.array([[u]])).item() == native


def test_each_real_step_of_a_repeated_control_counts():
    real, states = real_of("Pendulum-v1"), States(make("Pendulum-v1").spec())
    found = episode(real, states, random_control(states, np.random.default_rng(0)), decisions=7, repeat=2)
    assert len(found) == 7
    assert real.steps == 14


def test_a_comparison_run_ends_at_its_step_budget_or_time_limit():
    real = real_of("Pendulum-v1", budget=3)
    real.reset()
    for _ in range(3):
        real.step(np.zeros(1))
    with pytest.raises(BudgetSpent):
        real.step(np.zeros(1))
    late = real_of("Pendulum-v1", seconds=-1.0)
    late.reset()
    with pytest.raises(OutOfTime):
        late.step(np.zeros(1))


def test_a_controller_with_action_repeat_holds_its_action():
    states = States(make("Pendulum-v1").spec())
    controller = Held(states, lambda q: q[:, 1:], repeat=2)
    shown = observe(states.spec, np.array([[0.0, 0.1], [0.0, 0.2]])).astype(np.float32)
    np.testing.assert_allclose(controller.actions([0, 1], shown), [[0.2], [0.4]], rtol=1e-6)
    np.testing.assert_allclose(controller.actions([0, 1], shown[::-1]), [[0.2], [0.4]], rtol=1e-6)
    np.testing.assert_allclose(controller.actions([1], shown[:1]), [[0.2]], rtol=1e-6)


def test_a_task_without_a_reward_formula_for_compared_methods_is_refused():
    spec = make("MountainCar-v0").spec()
    with pytest.raises(NotApplicable, match="has to know the reward"):
        told(spec)
