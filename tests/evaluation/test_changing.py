"""The machines of the study of audits: a change does what its name says, and returns are those of single steps."""

from __future__ import annotations

import numpy as np
import pytest

from support.changing import MACHINES, RIGHT, SHIFTED, Changing, Machine, parameters_of
from surrogym_server.convert import definition_from_spec

NAMES = [machine.name for machine in MACHINES]


@pytest.mark.parametrize("machine", MACHINES, ids=NAMES)
def test_each_simulated_machine_of_the_drift_study_is_unchanged_without_a_fault(machine: Machine) -> None:
    definition_from_spec(machine.spec)
    assert parameters_of(machine, RIGHT, 1.0) == dict(machine.real)


@pytest.mark.parametrize("machine", MACHINES, ids=NAMES)
def test_every_fault_of_the_drift_study_changes_the_steps_of_its_machine(machine: Machine) -> None:
    rng = np.random.default_rng(0)
    low, high = np.array(list(machine.ranges.values())).T
    q, u = rng.uniform(low, high, (50, len(low))), rng.uniform(-1, 1, (50, machine.actions))
    real = machine.step(q, u, machine.real, np.random.default_rng(1))
    for mechanism in machine.wrong:
        other = machine.step(q, u, parameters_of(machine, mechanism, 0.5), np.random.default_rng(1))
        assert not all(np.allclose(a, b) for a, b in zip(real, other, strict=True)), mechanism


def test_a_shifted_sensor_offsets_both_states_of_a_step() -> None:
    (machine,) = [machine for machine in MACHINES if machine.name == "mass"]
    q, u = np.array([0.3, 0.1]), np.array([0.5])
    parameters = parameters_of(machine, SHIFTED, 0.5)
    moved = np.array([parameters["shift"], 0.0])
    seen, real = (Changing(machine, p).step_from(at, u) for p, at in ((parameters, q + moved), (machine.real, q)))
    np.testing.assert_allclose(np.asarray(seen.next_coordinates) - moved, real.next_coordinates)
    assert seen.reward == pytest.approx(real.reward)


def test_returns_of_a_simulated_machine_computed_in_batches_equal_those_of_single_steps() -> None:
    (machine,) = [machine for machine in MACHINES if machine.name == "pole"]
    rng = np.random.default_rng([3, 77])
    low, high = np.array(list(machine.start.values())).T
    state, environment, total = rng.uniform(low, high, (1, len(low)))[0], Changing(machine, machine.real), 0.0
    for _ in range(machine.time_limit):
        step = environment.step_from(state, np.array([0.2]))
        state, total = np.asarray(step.next_coordinates), total + step.reward
        if step.terminated:
            break
    found = machine.returns(lambda o: np.full((len(o), 1), 0.2), 1, 3)
    assert found[0] == pytest.approx(total)
