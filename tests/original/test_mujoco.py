"""The MuJoCo adapter says the truth about Gymnasium's own environments."""

import gymnasium
import numpy as np
import pytest

from surrogym_sampler import original
from surrogym_sampler.original.mujoco_tasks import SPECIFICATIONS
from surrogym_shared import terms
from surrogym_shared.spec import limits

pytest.importorskip("mujoco")
pytest.importorskip("imageio")


def random_place(spec, rng):
    boxes = np.array([limits(c.sampling) for c in spec.coordinates])
    return rng.uniform(boxes[:, 0], boxes[:, 1])


@pytest.mark.parametrize("name", SPECIFICATIONS)
def test_the_declared_observation_of_mujoco_tasks_equals_gymnasiums(name):
    """At states that were set: a step shows body positions of the last Runge-Kutta stage, not of its end."""
    environment = original.make(name)
    spec = environment.spec()
    rng = np.random.default_rng(0)
    for _ in range(30):
        place = random_place(spec, rng)
        environment.place(place)
        shown = environment.simulator.observe()
        declared = terms.observe(spec, place[None])[0]
        if "constraint" in spec.observation_names:
            shown = shown[:-1] if abs(place[0]) > 0.85 else shown
        np.testing.assert_allclose(declared[: len(shown)], shown, atol=1e-9)


@pytest.mark.parametrize("name", SPECIFICATIONS)
def test_the_declared_termination_of_mujoco_tasks_equals_gymnasiums(name):
    environment = original.make(name)
    spec = environment.spec()
    rng = np.random.default_rng(0)
    compared = 0
    for _ in range(60):
        action = rng.uniform(spec.action.low, spec.action.high)
        step = environment.step_from(random_place(spec, rng), action)
        if "slider" in spec.coordinate_names and abs(step.next_coordinates[0]) > 0.9:
            continue  # the rail's end is a termination of the specification alone
        compared += 1
        assert terms.terminates(spec, step.next_coordinates[None])[0] == step.terminated
    assert compared > 20


@pytest.mark.parametrize("name", SPECIFICATIONS)
def test_step_from_reproduces_the_mujoco_trajectory_of_gymnasium(name):
    environment = original.make(name)
    spec = environment.spec()
    columns = environment.simulator.columns(spec.coordinate_names)
    real = gymnasium.make(name).unwrapped
    real.reset(seed=1)
    rng = np.random.default_rng(1)
    for _ in range(10):
        action = rng.uniform(spec.action.low, spec.action.high)
        before = real.state_vector()[columns]
        _, reward, terminated, _, _ = real.step(action.astype(np.float32))
        step = environment.step_from(before, action)
        np.testing.assert_allclose(step.next_coordinates, real.state_vector()[columns], atol=1e-7)
        assert step.reward == pytest.approx(reward, abs=1e-7)
        assert step.terminated == terminated
