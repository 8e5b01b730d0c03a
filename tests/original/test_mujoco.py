"""The MuJoCo adapter says the truth about Gymnasium's own environments."""

import gymnasium
import numpy as np
import pytest

from surrogym_client import original
from surrogym_client.original import terms
from surrogym_client.original.errors import UnknownEnvironment
from surrogym_client.original.mujoco_tasks import SPECIFICATIONS
from surrogym_client.original.recognise import recognise
from surrogym_shared.spec import limits

pytest.importorskip("mujoco")
pytest.importorskip("imageio")

SPEEDS = {"slider_velocity": (-3, 3), "hinge_velocity": (-6, 6)}


def random_place(spec, rng):
    boxes = np.array([limits(c.sampling) for c in spec.coordinates])
    return rng.uniform(boxes[:, 0], boxes[:, 1])


@pytest.mark.parametrize("name", SPECIFICATIONS)
def test_declared_observation_is_the_environments_own(name):
    """At states that were set: a step shows body positions of the last Runge-Kutta stage, not of its end."""
    environment = original.make(name)
    spec = environment.spec()
    rng = np.random.default_rng(0)
    for _ in range(30):
        place = random_place(spec, rng)
        environment._joints.write(environment._columns, place)
        shown = environment._env._get_obs()
        declared = terms.observe(spec, place[None])[0]
        if "constraint" in spec.observation_names:
            shown = shown[:-1] if abs(place[0]) > 0.85 else shown
        np.testing.assert_allclose(declared[: len(shown)], shown, atol=1e-9)


@pytest.mark.parametrize("name", SPECIFICATIONS)
def test_declared_termination_is_the_environments_own(name):
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
def test_step_from_follows_the_environments_own_trajectory(name):
    environment = original.make(name)
    spec = environment.spec()
    joints = environment._joints
    columns = joints.columns(spec.coordinate_names)
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


def test_a_known_observation_is_recognised_without_a_step():
    spec = recognise("InvertedPendulum-v5", SPEEDS)
    declared = SPECIFICATIONS["InvertedPendulum-v5"]()
    places = np.random.default_rng(0).uniform(-0.2, 0.2, (5, 4))
    np.testing.assert_allclose(terms.observe(spec, places), terms.observe(declared, places), atol=1e-9)
    assert spec.time_limit == 1000


def test_a_recognised_specification_makes_an_environment():
    spec = recognise("InvertedPendulum-v5", SPEEDS)
    step = original.make("InvertedPendulum-v5", spec=spec).step_from(np.zeros(4), np.array([1.0]))
    assert step.next_coordinates[0] > 0


def test_what_terms_can_not_express_is_refused():
    wide = dict.fromkeys(("slider_velocity", "hinge_velocity", "hinge2_velocity"), (-20.0, 20.0))
    with pytest.raises(UnknownEnvironment, match="are no sums of 1, q, sin and cos"):
        recognise("InvertedDoublePendulum-v5", {"hinge": (-1, 1), "hinge2": (-1, 1), **wide})


def test_missing_ranges_and_unknown_joints_are_named():
    with pytest.raises(UnknownEnvironment, match=r"ranges lack \['slider_velocity', 'hinge_velocity'\]"):
        recognise("InvertedPendulum-v5", {})
    with pytest.raises(UnknownEnvironment, match=r"coordinates \['elbow'\] are no joints"):
        recognise("InvertedPendulum-v5", {"elbow": (-1, 1)})


def test_free_joints_are_refused():
    with pytest.raises(UnknownEnvironment, match="free and ball joints"):
        recognise("Ant-v5", {})


def test_an_undescribed_environment_asks_for_a_specification():
    with pytest.raises(UnknownEnvironment, match="Hopper-v5 has no built-in specification"):
        original.make("Hopper-v5")
