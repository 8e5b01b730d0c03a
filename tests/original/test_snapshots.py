"""A return to a saved state: the same steps follow, bit for bit, in any process."""

from __future__ import annotations

import shlex
from pathlib import Path

import numpy as np
import pytest

from support.rail import SPEC, Rail
from surrogym_sampler import original
from surrogym_sampler.original.errors import StepFailed, UnknownEnvironment
from surrogym_sampler.original.rollouts import FromReset, answering
from surrogym_shared.spec import with_history

SHELL = Path(__file__).parents[2] / "examples" / "executables" / "rail.sh"
CLASSIC = ("Pendulum-v1", "CartPole-v1", "MountainCarContinuous-v0", "Acrobot-v1", "surrogym/CartPoleSwingUp-v0")


class SavedRail(Rail):
    """The rail, with snapshots."""

    def spec(self):
        return SPEC.model_copy(update={"snapshots": True})

    def save(self):
        return repr(float(self.x)).encode()

    def restore(self, snapshot):
        self.x = float(snapshot)
        return np.array([self.x, self.x])


def going(environment, count, seed=0):
    """Take steps with random actions; their results."""
    rng, taken = np.random.default_rng(seed), []
    for _ in range(count):
        action = environment.spec().action
        u = rng.uniform(action.low, action.high) if action.kind == "box" else rng.integers(action.n, size=1)
        step = environment.act(np.asarray(u, dtype=np.float64))
        taken.append((*np.asarray(step.next_coordinates).tolist(), step.reward, step.terminated))
    return taken


@pytest.mark.parametrize("name", CLASSIC)
def test_a_classic_task_repeats_its_steps_after_restoring_a_snapshot(name):
    there, elsewhere = (original.make(name, access="snapshot") for _ in range(2))
    there.begin(3)
    going(there, 4)
    snapshot = there.save()
    first = going(there, 5, seed=1)
    elsewhere.begin(8)
    back = elsewhere.restore(snapshot)
    assert going(elsewhere, 5, seed=1) == first
    there.restore(snapshot)
    assert there.save() == snapshot
    assert len(back) == len(there.spec().coordinates)
    for environment in (there, elsewhere):
        environment.close()


def test_a_mujoco_task_repeats_its_steps_after_restoring_a_snapshot():
    pytest.importorskip("mujoco")
    plant = original.make("InvertedDoublePendulum-v5", access="snapshot")
    plant.begin(0)
    going(plant, 3)
    snapshot = plant.save()
    first = going(plant, 3, seed=1)
    plant.begin(1)
    plant.restore(snapshot)
    assert going(plant, 3, seed=1) == first
    plant.close()


def test_a_user_defined_class_returns_its_coordinates_after_restoring_a_snapshot():
    rail = answering(SavedRail())
    assert isinstance(rail, FromReset)
    start = rail.begin(0)
    snapshot = rail.save()
    rail.act(np.ones(1))
    assert list(rail.restore(snapshot)) == list(start)
    assert list(rail.act(np.ones(1)).coordinates) == list(start)


def test_an_environment_program_can_restore_its_snapshot():
    plant = original.make(f"exec:{shlex.quote(str(SHELL))}", access="snapshot")
    plant.begin()
    plant.act(np.ones(1))
    snapshot = plant.save()
    plant.act(np.ones(1))
    assert list(plant.restore(snapshot)) == [1.0]
    assert list(plant.act(np.zeros(1)).next_coordinates) == [0.0]
    plant.close()


@pytest.mark.parametrize("snapshot", [b"", b"nonsense", original.make("CartPole-v1").save()])
def test_restoring_bytes_that_are_no_snapshot_of_the_task_is_refused(snapshot):
    plant = original.make("Pendulum-v1", access="snapshot")
    with pytest.raises(StepFailed, match="expected a snapshot with"):
        plant.restore(snapshot)
    plant.close()


def test_declaring_snapshots_without_save_and_restore_is_refused():
    class Half(SavedRail):
        restore = None

    with pytest.raises(UnknownEnvironment, match="need the methods save and restore"):
        answering(Half())


def test_restoring_a_snapshot_restores_the_lagged_coordinates():
    spec = SPEC.model_copy(update={"snapshots": True})
    lagged = with_history(spec, changes=1, actions=1, largest={"x": 0.2})

    class Remembering(SavedRail):
        def spec(self):
            return lagged

    rail = answering(Remembering())
    rail.begin(0)
    rail.act(np.ones(1))
    snapshot, before = rail.save(), rail.act(np.zeros(1)).coordinates
    rail.begin(1)
    assert list(rail.restore(snapshot)) == list(before)
    assert list(rail.act(np.zeros(1)).coordinates) == list(before)
