"""An FMU is set, stepped and saved bit for bit, and a fault of its native code costs one query."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from support.fmus import (
    EXAMPLES,
    MOODY,
    OF_VERSION_3,
    STATES,
    STUBBORN,
    bits,
    build,
    build_text,
    changed,
    mapping,
    rewarded,
    squared,
)
from surrogym_sampler import original
from surrogym_sampler.original.describing import describe
from surrogym_sampler.original.episodes import open_episode
from surrogym_sampler.original.errors import EnvironmentDied, StepFailed, StepTimedOut, UnknownEnvironment
from surrogym_sampler.original.fmus.adapter import Fmu, FmuEnvironment, open_simulator
from surrogym_sampler.original.loading import fits, is_known, isolated
from surrogym_sampler.priors.calibration import Parameter, RealTransitions, adjustable, calibrate
from surrogym_shared.spec import (
    BoxAction,
    Coordinate,
    DeclaredReward,
    EnvironmentSpec,
    Inequality,
    ObservationEntry,
    Term,
    Uniform,
)

FIELDS = ("coordinates", "action", "next_coordinates")

pytest.importorskip("fmpy")
pytest.importorskip("pythonfmu")


@pytest.fixture(scope="module")
def tanks(tmp_path_factory) -> Path:
    return build(EXAMPLES / "two_tanks.py", tmp_path_factory.mktemp("tanks"), *STATES)


@pytest.fixture(scope="module")
def pendulum(tmp_path_factory) -> Path:
    return build(EXAMPLES / "inverted_pendulum.py", tmp_path_factory.mktemp("pendulum"), *STATES)


@pytest.fixture(scope="module")
def moody(tmp_path_factory) -> Path:
    return build_text(MOODY, "moody", tmp_path_factory.mktemp("moody"))


@pytest.fixture(scope="module")
def heater(tmp_path_factory) -> Path:
    pytest.importorskip("pythonfmu3")
    return build_text(OF_VERSION_3, "heater", tmp_path_factory.mktemp("heater"), *STATES, builder="pythonfmu3")


def opened(name: object) -> Fmu:
    simulator = open_simulator(str(name))
    assert isinstance(simulator, Fmu)
    return simulator


def states(fmu: Fmu, actions: np.ndarray) -> list[np.ndarray]:
    """The states after each of some actions, (n, V)."""
    reached = []
    for action in actions:
        fmu.step(action)
        reached.append(fmu.read())
    return reached


def drawn(fmu: Fmu, number: int) -> np.ndarray:
    """Random actions (number, F)."""
    rng = np.random.default_rng(0)
    return rng.uniform(fmu.action.low, fmu.action.high, (number, len(fmu.action.low)))  # type: ignore[union-attr]


def moody_with_limits(moody: Path, folder: Path, step_limit: float = 30.0) -> FmuEnvironment:
    name = mapping(folder, fmu=str(moody), step=0.5, actions={"push": [-5, 5]})
    spec = EnvironmentSpec(
        environment=name,
        coordinates=(Coordinate(name="x", sampling=Uniform(low=-1, high=1)),),
        observation=(ObservationEntry(name="x", term=Term.linear(x=1)),),
        action=BoxAction(low=(-5,), high=(5,)),
        start={"x": Uniform(low=-1, high=1)},
        reward=DeclaredReward(kind="declared", terms=(squared("x"),)),
    )
    made = isolated(name, step_limit, spec)
    assert isinstance(made, FmuEnvironment)
    return made


@pytest.mark.parametrize("which", ["tanks", "pendulum", "heater"])
def test_fmu_episodes_and_restored_snapshots_replay_bit_equal(which: str, request) -> None:
    fmu = opened(f"fmu:{request.getfixturevalue(which)}")
    try:
        actions = drawn(fmu, 40)
        fmu.reset(None)
        first = states(fmu, actions[:20])
        snapshot = fmu.save()
        later = states(fmu, actions[20:])
        fmu.restore(snapshot)
        assert bits(*states(fmu, actions[20:])) == bits(*later)
        fmu.reset(None)
        assert bits(*states(fmu, actions)) == bits(*first, *later)
        assert len({row.tobytes() for row in first}) > 1
    finally:
        fmu.close()


@pytest.mark.parametrize("which", ["tanks", "pendulum", "heater"])
def test_an_fmu_set_to_any_state_steps_on_bit_equal(which: str, request) -> None:
    fmu = opened(f"fmu:{request.getfixturevalue(which)}")
    try:
        (action, other) = drawn(fmu, 2)
        fmu.reset(None)
        fmu.step(other)
        before = fmu.read()
        fmu.step(action)
        after = fmu.read()
        fmu.write(before)
        assert bits(fmu.read()) == bits(before)
        fmu.step(action)
        assert bits(fmu.read()) == bits(after)
        assert bits(before) != bits(after)
    finally:
        fmu.close()


def test_an_fmu_snapshot_can_be_restored_in_another_process(tanks: Path) -> None:
    one, other = opened(f"fmu:{tanks}"), opened(f"fmu:{tanks}")
    try:
        one.step(np.ones(1))
        snapshot, at = one.save(), one.read()
        other.restore(snapshot)
        assert bits(other.read()) == bits(at)
    finally:
        one.close()
        other.close()


def test_restoring_an_fmu_snapshot_of_another_file_is_refused(tanks: Path, tmp_path: Path) -> None:
    one = opened(f"fmu:{tanks}")
    other = opened(mapping(tmp_path, fmu=str(tanks), start={"flow": 1e-4}))
    try:
        with pytest.raises(StepFailed, match=r"as it is now, .* another file, step or start: delete"):
            other.restore(one.save())
        with pytest.raises(StepFailed, match=r"expected a snapshot of TwoTanks.fmu, got 5 other bytes"):
            other.restore(b"hello")
    finally:
        one.close()
        other.close()


def test_fmu_states_that_cannot_be_serialised_are_lost_with_their_process(tanks: Path, tmp_path: Path) -> None:
    quiet = changed(tanks, tmp_path / "quiet.fmu", {'canSerializeFMUstate="true"': 'canSerializeFMUstate="false"'})
    one, other = opened(f"fmu:{quiet}"), opened(f"fmu:{quiet}")
    try:
        one.step(np.ones(1))
        snapshot, at = one.save(), one.read()
        one.step(np.ones(1))
        one.restore(snapshot)
        assert bits(one.read()) == bits(at)
        with pytest.raises(StepFailed, match="dropped from memory"):
            other.restore(snapshot)
    finally:
        one.close()
        other.close()


def test_fmu_parameters_and_start_values_are_read_from_a_file(tanks: Path, tmp_path: Path) -> None:
    slow = opened(mapping(tmp_path, fmu=str(tanks), step=5.0, start={"flow": 0.0, "upper": 0.5, "lower": 0}))
    try:
        assert slow.time_limit == 200
        assert slow.read().tolist() == [0.5, 0.0]
        slow.step(np.ones(1))
        assert slow.read()[0] < 0.5  # the pump has no flow
    finally:
        slow.close()


def test_a_parameter_of_an_fmu_is_calibrated_on_real_steps_of_another_one(tanks: Path, tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    spec = rewarded(f"fmu:{tanks}", squared("lower", wanted=0.4), steps=20)
    real = mapping(tmp_path / "real", fmu=str(tanks), start={"flow": 0.0005})
    plant = original.make(real, spec=spec.model_copy(update={"environment": real}))
    simulator = original.make(f"fmu:{tanks}", spec=spec)
    try:
        rng = np.random.default_rng(0)
        steps = [plant.step_from(rng.uniform(0.1, 0.9, 2), rng.uniform(0, 1, 1)) for _ in range(6)]
        taken = RealTransitions(*(np.array([getattr(s, f) for s in steps]) for f in FIELDS))
        plain = adjustable(simulator)
        assert plain.parameters() == {"flow": 2.8e-4}

        def step(values: np.ndarray, coordinates: np.ndarray, action: np.ndarray) -> np.ndarray:
            plain.set_parameters({"flow": float(values[0])})
            return simulator.step_from(coordinates, action).next_coordinates

        found = calibrate(spec, taken, [Parameter("flow", 0.0002, 0.0008)], np.array([2.8e-4]), step)
        assert found.values["flow"] == pytest.approx(0.0005, rel=1e-4)
    finally:
        plant.close()
        simulator.close()


def test_describing_an_fmu_asks_for_reward_and_limits(moody: Path, tmp_path: Path) -> None:
    found = describe(mapping(tmp_path, fmu=str(moody), step=0.5), steps=20)
    asked = " ".join(found.asked)
    assert "reward: the environment has none. Declare one" in asked
    assert "push declares no min and max, so -1 to 1 is assumed" in asked
    assert not found.pays
    assert found.spec.query == "step"


def test_an_fmu_variable_in_radians_is_described_as_angle(pendulum: Path) -> None:
    spec = describe(f"fmu:{pendulum}", steps=40).spec
    assert [(c.name, c.kind) for c in spec.coordinates] == [("angle", "angle"), ("speed", "linear")]
    assert spec.action.low == (-5.0,)  # type: ignore[union-attr]
    assert spec.time_limit == 100


def test_describing_an_fmu_declares_the_step_duration(tanks: Path, tmp_path: Path) -> None:
    assert describe(f"fmu:{tanks}", steps=20).spec.sampling_period == 10.0
    assert describe(mapping(tmp_path, fmu=str(tanks), step=5.0), steps=20).spec.sampling_period == 5.0


def test_an_fmu_episode_uses_reward_start_and_termination_of_the_specification(tanks: Path) -> None:
    name = f"fmu:{tanks}"
    full = Inequality(term=Term.linear(upper=1), relation=">", value=0.9)
    spec = rewarded(name, squared("lower", wanted=0.4)).model_copy(
        update={
            "termination": ((full,),),
            "start": {"upper": Uniform(low=0.95, high=1), "lower": Uniform(low=0, high=1)},
        }
    )
    episode = open_episode(name, spec, lambda: original.make(name, spec=spec))
    try:
        starts = [episode.reset(seed).coordinates for seed in (0, 1, 0)]
        assert bits(starts[0]) == bits(starts[2]) != bits(starts[1])
        moment = episode.step(np.ones(1))
        assert moment.terminated
        assert moment.reward == pytest.approx(-((moment.coordinates[1] - 0.4) ** 2), abs=1e-15)
    finally:
        episode.close()


def test_an_fmu_without_a_declared_reward_is_refused(tanks: Path) -> None:
    name = f"fmu:{tanks}"
    spec = describe(name, steps=20).spec
    with pytest.raises(UnknownEnvironment, match=r"expected a declared reward .* surrogym describe"):
        original.make(name, spec=spec)


def test_a_specification_from_a_server_never_opens_an_fmu() -> None:
    assert not is_known("fmu:plant.fmu")
    assert not is_known("fmu:plant.json")


@pytest.mark.parametrize(
    ("push", "message"),
    [
        (1.5, r"the process of Moody.fmu ended with exit code -6 \(SIGABRT\) during step"),
        (3.0, r"Moody.fmu refused the request step: expected finite values from the FMU, got x is nan"),
        (4.0, r"Moody.fmu refused the request step: the FMU answered fmi2DoStep with status"),
    ],
)
def test_a_crash_of_fmu_native_code_costs_one_step(moody: Path, tmp_path: Path, push: float, message: str) -> None:
    plant = moody_with_limits(moody, tmp_path)
    try:
        good = plant.step_from(np.array([0.5]), np.array([-1.0]))
        with pytest.raises(StepFailed, match=message):
            plant.step_from(np.array([0.5]), np.array([push]))
        with pytest.raises(StepFailed, match=r"to have a state, got none"):
            plant.act(np.zeros(1))
        again = plant.step_from(np.array([0.5]), np.array([-1.0]))
        assert bits(again.next_coordinates) == bits(good.next_coordinates)
    finally:
        plant.close()


def test_a_hanging_fmu_is_killed_and_restarted(moody: Path, tmp_path: Path) -> None:
    plant = moody_with_limits(moody, tmp_path, step_limit=5.0)
    try:
        with pytest.raises(
            StepTimedOut, match=r"the process of Moody.fmu did not answer step .* a larger --step-limit"
        ):
            plant.step_from(np.array([0.5]), np.array([2.0]))
        assert plant.step_from(np.array([0.5]), np.zeros(1)).reward == -0.25
    finally:
        plant.close()


def test_a_crash_of_an_fmu_at_a_later_step_is_reported(moody: Path, tmp_path: Path) -> None:
    plant = moody_with_limits(moody, tmp_path)
    try:
        plant.begin(0)
        with pytest.raises(EnvironmentDied):
            plant.act(np.array([1.5]))
        assert np.isfinite(plant.begin(0)).all()
    finally:
        plant.close()


def test_an_fmu_without_native_snapshots_saves_its_settable_variables(moody: Path, tmp_path: Path) -> None:
    plant = moody_with_limits(moody, tmp_path)
    try:
        start = plant.begin(0)
        snapshot = plant.save()
        plant.act(np.array([-1.0]))
        assert bits(plant.restore(snapshot)) == bits(start)
    finally:
        plant.close()


def test_an_fmu_whose_state_cannot_be_set_exactly_is_reset_only(tmp_path: Path) -> None:
    stubborn = build_text(STUBBORN, "stubborn", tmp_path)
    fmu = opened(mapping(tmp_path, fmu=str(stubborn), step=1.0))
    try:
        assert not fmu.settable
        assert fmu.fixed == "x was started at 0.35 and read back as 0.25, so it can only be reset"
        with pytest.raises(UnknownEnvironment, match="--access reset"):
            fmu.write(np.ones(1))
    finally:
        fmu.close()


def test_an_fmu_with_read_only_states_is_used_by_reset_and_snapshots(tanks: Path, tmp_path: Path) -> None:
    read_only = changed(tanks, tmp_path / "read.fmu", {' initial="exact"': "", ' start="0.1"': ""})
    spec = rewarded(f"fmu:{read_only}", squared("lower", wanted=0.4))
    assert spec.access == "snapshot"
    plant = original.make(f"fmu:{read_only}", spec=spec)
    assert isinstance(plant, FmuEnvironment)
    try:
        assert plant.begin(0).tolist() == [0.1, 0.1]
        there = plant.act(np.ones(1)).next_coordinates
        assert np.asarray(there)[0] > 0.1
        snapshot = plant.save()
        after = plant.act(np.ones(1)).next_coordinates
        assert bits(plant.restore(snapshot)) == bits(there)
        assert bits(plant.act(np.ones(1)).next_coordinates) == bits(after)
    finally:
        plant.close()


def test_closing_an_fmu_leaves_no_temporary_files(tanks: Path, monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    fmu = opened(f"fmu:{tanks}")
    assert os.listdir(tmp_path)
    fmu.close()
    assert os.listdir(tmp_path) == []


def test_an_fmu_specification_fits_the_same_file_in_another_folder(tanks: Path) -> None:
    spec = rewarded(f"fmu:{tanks}", squared("lower"), steps=20).model_copy(update={"environment": "fmu:TwoTanks.fmu"})
    original.make(f"fmu:{tanks}", spec=spec).close()
    assert fits("fmu:TwoTanks.fmu", f"fmu:{tanks}")
    assert not fits("fmu:Other.fmu", f"fmu:{tanks}")
    with pytest.raises(
        UnknownEnvironment, match=r"expected a specification of .*, got one of fmu:Other.fmu: if .*, write"
    ):
        original.make(f"fmu:{tanks}", spec=spec.model_copy(update={"environment": "fmu:Other.fmu"}))
