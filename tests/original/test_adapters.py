"""What an adapter opens stands where it was set, steps from there as it would by itself, and begins anew by its seed.

The adapters of packages run where those are installed: make test-all has an environment for them.
"""

from __future__ import annotations

import json
import sys
from importlib.util import find_spec
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from support.simulators import CASES, Register, installed
from surrogym_sampler.original.adapters import open_simulator
from surrogym_sampler.original.adapters.parts import action_of
from surrogym_sampler.original.adapters.pcgym.adapter import parameters_of
from surrogym_sampler.original.errors import UnknownEnvironment
from surrogym_sampler.original.simulator import Simulator


def random_action(simulator: Simulator, rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(simulator.action.low, simulator.action.high)  # type: ignore[union-attr]


@pytest.mark.filterwarnings("ignore")  # of the packages themselves
@pytest.mark.parametrize("name", CASES)
def test_a_simulator_step_from_a_set_state_equals_that_of_its_episode(name: str) -> None:
    simulator, rng = open_simulator(name), np.random.default_rng(0)
    simulator.reset(3)
    for _ in range(5):
        simulator.step(random_action(simulator, rng))
    before, action = simulator.read(), random_action(simulator, rng)
    taken, after = simulator.step(action), simulator.read()
    for _ in range(3):
        simulator.step(random_action(simulator, rng))
    simulator.write(before)
    np.testing.assert_allclose(simulator.read(), before, atol=1e-12)
    again = simulator.step(action)
    np.testing.assert_allclose(simulator.read(), after, atol=1e-9)
    assert again.reward == pytest.approx(taken.reward, abs=1e-9)
    assert np.abs(after - before).max() > 0
    simulator.close()


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", CASES)
def test_two_simulator_resets_with_one_seed_are_equal(name: str) -> None:
    simulator = open_simulator(name)
    simulator.reset(5)
    first = simulator.read()
    simulator.reset(6)
    simulator.reset(5)
    np.testing.assert_array_equal(simulator.read(), first)
    simulator.close()


@installed("dm_control")
@pytest.mark.filterwarnings("ignore")
def test_a_dm_control_task_gives_the_same_steps_as_dm_control_itself() -> None:
    from dm_control import suite

    ours = open_simulator("dm_control:cartpole-swingup")
    theirs = suite.load("cartpole", "swingup", task_kwargs={"random": 7})
    ours.reset(7)
    theirs.reset()
    rng = np.random.default_rng(0)
    for _ in range(20):
        action = random_action(ours, rng)
        taken, step = ours.step(action), theirs.step(action)
        shown = np.concatenate([np.ravel(entry) for entry in step.observation.values()])
        np.testing.assert_allclose(taken.observation, shown, atol=1e-12)
        assert taken.reward == pytest.approx(step.reward, abs=1e-12)
    assert ours.time_limit == 1000


@pytest.mark.parametrize("name", ["dm_control:cartpole-fly", "dm_control:nothing"])
@installed("dm_control")
def test_the_error_for_an_unknown_dm_control_task_names_it(name: str) -> None:
    with pytest.raises(UnknownEnvironment, match="expected dm_control:DOMAIN-TASK, such as"):
        open_simulator(name)


@pytest.mark.parametrize(("name", "package"), [("dm_control:cartpole-swingup", "dm_control"), ("pcgym:cstr", "pcgym")])
def test_the_error_for_a_missing_simulator_package_names_its_extra(name: str, package: str) -> None:
    if find_spec(package):
        pytest.skip(f"{package} is installed here")
    extra = package.replace("_", "-")
    with pytest.raises(UnknownEnvironment, match=rf"pip install 'surrogym\[{extra}\]'"):
        open_simulator(name)


@installed("pcgym")
def test_after_a_reset_the_setpoint_coordinate_is_the_one_the_first_reward_uses() -> None:
    """Neither opens, resets nor steps with a warning, which would be an error here."""
    tank = open_simulator("pcgym:cstr")
    setpoint = tank.reset(0)[2]
    reward = tank.step(np.zeros(1)).reward
    assert setpoint == 0.85
    assert reward == pytest.approx(-((tank.read()[0] - setpoint) ** 2))


TANK = {
    "model": "cstr",
    "N": 10,
    "tsim": 3,
    "SP": {"Ca": [0.85] * 5 + [0.9] * 5},
    "x0": [0.8, 330, 0.8],
    "a_space": {"low": [295], "high": [302]},
    "o_space": {"low": [0.7, 300, 0.8], "high": [1.0, 350, 0.9]},
}


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"a_space": [1, 2]}, r"expected a_space to be an object with low and high, .* got \[1, 2\]"),
        (
            {"a_space": {"low": [302], "high": [295]}},
            "expected low of a_space to be below the corresponding high value",
        ),
        ({"o_space": {"low": [0.0]}}, "expected o_space to be an object with low and high"),
        ({"o_space": {"low": [0.0], "high": [float("inf")]}}, "expected o_space to be .* finite numbers"),
        (
            {"o_space": {"low": [0.5], "high": [0.5]}},
            "expected low of o_space to be below the corresponding high value",
        ),
        ({"x0": "cold"}, 'expected the parameter x0 to be a list of finite numbers, got "cold"'),
        ({"x0": [float("nan")]}, "expected the parameter x0 to be a list of finite numbers"),
        ({"SP": {}}, "expected SP to be an object"),
        ({"SP": {"Ca": 0.85}}, "expected SP of Ca to be a list of finite numbers, got 0.85"),
        ({"SP": {"Ca": []}}, "expected SP of Ca to be a list"),
        ({"SP": {"Ca": ["a"] * 10}}, "expected SP of Ca to be a list"),
        ({"SP": {"Ca": [[0.8, 0.9]] * 10}}, "expected SP of Ca to be a list"),
        ({"SP": {"Ca": [0.85] * 9}}, "expected SP of Ca to have a value for each of the N = 10 samples, got 9"),
        ({"disturbances": {"Ti": [350] * 10}}, "no disturbance_bounds"),
        ({"N": 1}, "expected the parameter N to be a whole number from 2 to 100,000, got 1"),
        ({"N": 10.5}, "expected the parameter N to be a whole number"),
        ({"N": "10"}, "expected the parameter N to be a whole number"),
        ({"N": 10**9}, "expected the parameter N to be a whole number"),
        ({"tsim": 0}, "expected the parameter tsim to be a positive number, got 0"),
        ({"model": 5}, "expected the parameter model to be the name of a model"),
    ],
)
def test_the_error_for_an_unusable_value_in_a_process_file_names_it(
    wrong: dict[str, object], message: str, tmp_path: Path
) -> None:
    file = tmp_path / "process.json"
    file.write_text(json.dumps(TANK | wrong))
    with pytest.raises(UnknownEnvironment, match=message):
        parameters_of(str(file))


@installed("pcgym")
@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"model": "nope"}, "expected the parameter model to be one of .*cstr.*, got 'nope'"),
        ({"SP": {"Zz": [0.85] * 10}}, "expected names of SP among Ca, T, got Zz"),
        ({"x0": [0.8, 330]}, "expected x0 to have 3 values .*states Ca, T, then setpoints of Ca.* got 2"),
        ({"SP": {"Ca": [0.85] * 10, "T": [330] * 10}}, "expected low and high of o_space to have 4 values"),
        ({"a_space": {"low": [295, 1], "high": [302, 2]}}, r"expected low and high of a_space to have 1 value \(Tc\)"),
        ({"constraints": {"T": [327]}}, "pc-gym refused the parameters of pcgym:.*KeyError: 'done_on_cons_vio'"),
    ],
)
def test_the_error_for_a_process_file_value_that_does_not_fit_names_it(
    wrong: dict[str, object], message: str, tmp_path: Path
) -> None:
    file = tmp_path / "process.json"
    file.write_text(json.dumps(TANK | wrong))
    with pytest.raises(UnknownEnvironment, match=message):
        open_simulator(f"pcgym:{file}")


@installed("pcgym")
def test_setpoints_scheduled_after_the_last_step_are_ignored(tmp_path: Path) -> None:
    file = tmp_path / "process.json"
    file.write_text(json.dumps(TANK | {"SP": {"Ca": [0.85] * 10 + [7.0]}}))
    assert open_simulator(f"pcgym:{file}").scheduled == {"Ca_setpoint": (0.85, 0.85)}


def test_discrete_action_spaces_that_do_not_start_at_zero_are_refused() -> None:
    space = gymnasium.spaces.MultiDiscrete([3, 3])
    assert action_of("Own-v0", space).nvec == (3, 3)  # type: ignore[union-attr]
    for later in (gymnasium.spaces.MultiDiscrete([3, 3], start=[0, 1]), gymnasium.spaces.Discrete(3, start=1)):
        with pytest.raises(UnknownEnvironment, match="Discrete or MultiDiscrete from 0"):
            action_of("Own-v0", later)


def test_the_parameters_of_a_process_simulator_are_read_from_a_file(tmp_path) -> None:
    file = tmp_path / "tank.json"
    file.write_text(json.dumps(TANK))
    read = parameters_of(str(file))
    assert read["a_space"]["high"].tolist() == [302.0]
    assert read["x0"].tolist() == [0.8, 330.0, 0.8]
    file.write_text(json.dumps(TANK | {"noise": True}))
    with pytest.raises(UnknownEnvironment, match="sets noise"):
        parameters_of(str(file))


@pytest.mark.parametrize(
    ("content", "message"),
    [("{", "is not JSON"), ("[]", "expected an object with model"), (None, "expected pcgym:cstr, or pcgym:FILE.json")],
)
def test_a_process_file_without_a_process_is_refused(tmp_path, content: str | None, message: str) -> None:
    file = tmp_path / "tank.json"
    if content is not None:
        file.write_text(content)
    with pytest.raises(UnknownEnvironment, match=message):
        parameters_of(str(file))


def test_the_attribute_state_of_a_gymnasium_environment_is_used_as_its_state(registered: Register) -> None:
    simulator = open_simulator(registered("Spiral-v0"))
    assert [variable.name for variable in simulator.variables] == ["state0", "state1"]
    simulator.write(np.array([1.0, 0.0]))
    simulator.step(np.array([0.0]))
    np.testing.assert_allclose(simulator.read(), [0.9, 0.1])
    assert simulator.time_limit == 30


def test_an_environment_with_unreadable_state_is_reset_only(registered: Register) -> None:
    simulator = open_simulator(registered("Hidden-v0", attribute="_hidden"))
    assert not simulator.settable
    with pytest.raises(UnknownEnvironment, match="its state can't be read"):
        simulator.write(np.zeros(2))


@pytest.mark.parametrize(
    ("space", "message"),
    [
        ({"action_space": gymnasium.spaces.Box(-np.inf, np.inf, (1,))}, "expected a Box with one row of finite bounds"),
        ({"action_space": gymnasium.spaces.MultiBinary(2)}, "expected a Box with one row of finite bounds"),
        ({"observation_space": gymnasium.spaces.Discrete(4)}, "a discrete observation"),
    ],
)
def test_gymnasium_spaces_that_a_specification_cannot_express_are_refused(
    registered: Register, space, message: str
) -> None:
    with pytest.raises(UnknownEnvironment, match=message):
        open_simulator(registered("Odd-v0", space=space))


def test_a_gymnasium_id_of_a_module_in_the_working_directory_is_opened(tmp_path, monkeypatch) -> None:
    """A factory there was found, and the id of a class in the same file was not."""
    lines = ["import gymnasium", "from support.simulators import Spiral", "gymnasium.register('Here-v0', Spiral)"]
    (tmp_path / "plant_here.py").write_text("\n".join(lines))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path])
    open_simulator("plant_here:Here-v0").close()
    gymnasium.registry.pop("Here-v0")


def test_an_observation_of_shape_n_by_1_is_not_refused_as_image():
    """An observation of shape (n, 1) was refused as an image."""
    from surrogym_sampler.original.adapters.parts import flat

    assert flat("own", {"b": np.ones((3, 1)), "a": np.zeros((1, 1))}).tolist() == [0, 1, 1, 1]
    with pytest.raises(UnknownEnvironment, match="observes images"):
        flat("own", np.ones((3, 2)))
