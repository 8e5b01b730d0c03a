"""A surrogate as an FMU passes the checks of FMI and steps as the served model does."""

from __future__ import annotations

import os
import shutil
import subprocess
import zipfile
from dataclasses import replace
from pathlib import Path

import fmpy
import numpy as np
import pytest
import torch
from fmpy.fmi1 import FMICallException
from fmpy.validation import validate_fmu

from support.real_steps import random_steps
from support.saying import speaker
from support.steps_in_c import COMPILER, needs_compiler
from support.twins import PERIOD, OpenFmu, drained, exported, opened, tanks
from surrogym.cli import main
from surrogym_sampler import original
from surrogym_sampler.original.classic import cartpole
from surrogym_server.convert import stored_definition
from surrogym_server.deployment import twin_of, write_twin
from surrogym_server.errors import InvalidInput
from surrogym_server.local import LocalSurrogate
from surrogym_server.models.files import from_bytes, to_bytes
from surrogym_shared import c_compiler, fmu
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.surrogate_file import SurrogateFile
from surrogym_shared.wire import OpenSession

pytestmark = needs_compiler
STEPS = 40
STATE = ("upper", "lower")
SHOWN = (*STATE, "deviation.upper", "deviation.lower", "reward")


@pytest.fixture(scope="module")
def surrogate() -> SurrogateFile:
    return exported("tanks", tanks(), drained(24))


@pytest.fixture(scope="module")
def twin(surrogate: SurrogateFile, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_twin(surrogate.to_bytes(), tmp_path_factory.mktemp("twin") / "tanks.fmu").path


def pumped(steps: int = STEPS) -> np.ndarray:
    return np.random.default_rng(0).uniform(0, 1, (steps, 1))


def driven(one: OpenFmu, actions: np.ndarray, name: str = "action", period: float = PERIOD) -> np.ndarray:
    """What is shown after each action (T, 1)."""
    rows = []
    for count, action in enumerate(actions):
        one.step(count * period, period, **{name: float(action[0])})
        rows.append(one.get(*SHOWN))
    return np.array(rows)


def test_a_surrogate_fmu_passes_the_fmi_checks_and_can_be_simulated(twin):
    assert validate_fmu(str(twin)) == []
    result = fmpy.simulate_fmu(str(twin), stop_time=200.0, start_values={"upper": 0.3, "action": 0.5})
    assert len(result) == 21
    assert result["upper"][0] == 0.3
    assert fmpy.read_model_description(str(twin)).defaultExperiment.stepSize == str(PERIOD)


def test_steps_of_a_surrogate_fmu_equal_those_of_the_served_model(surrogate, twin):
    model = LocalSurrogate.from_bytes(surrogate.spec, surrogate.model).model
    q, rows = torch.tensor([[0.3, 0.1]], dtype=torch.float64), []
    for action in pumped():
        moved = model.transition(q, torch.from_numpy(action[None]), stds=True)
        q = moved.q_next
        rows.append([*q[0].tolist(), *moved.std[0].tolist(), float(moved.reward)])
    with opened(twin) as one:
        one.begin({"upper": 0.3, "lower": 0.1})
        np.testing.assert_allclose(driven(one, pumped()), rows, rtol=1e-9, atol=1e-9)


def test_observations_terminations_and_rewards_of_a_surrogate_fmu_equal_a_sessions(tmp_path):
    """Cart-pole has discrete actions, declared ends and a reward beyond one of them."""
    file = exported("cart-pole", cartpole(), random_steps(cartpole(), 20, seed=0))
    names = file.spec.observation_names
    local = LocalSurrogate.from_bytes(file.spec, file.model)
    session = local.open(OpenSession(num_envs=1, autoreset_mode="disabled", time_limit=500))
    shown = local.reset(session.id, seed=3).observation[0]
    with opened(write_twin(file.to_bytes(), tmp_path / "pole.fmu", 0.02).path) as one:
        one.begin(dict(zip(file.spec.coordinate_names, map(float, shown), strict=True)))
        for count in range(500):
            ours = local.step(session.id, np.array([count % 2]))
            one.step(0.02 * count, 0.02, action=count % 2)
            taken = [n if n not in file.spec.coordinate_names else f"observation.{n}" for n in names]
            np.testing.assert_allclose(one.get(*taken), ours.observation[0], rtol=1e-4, atol=1e-4)
            assert one.get("reward")[0] == pytest.approx(ours.reward[0], abs=1e-6)
            assert bool(one.get("terminated")[0]) == bool(ours.terminated[0])
            if ours.terminated[0]:
                break
    assert ours.terminated[0]


@pytest.mark.parametrize("share", [0.25, 1 / 3, 3.0])
def test_a_surrogate_fmu_gives_the_same_states_with_another_communication_step_of_the_importer(twin, share):
    """An input holds from one sampling instant to the next; a change in between waits."""
    with opened(twin) as one, opened(twin) as other:
        one.begin()
        other.begin()
        for count in range(12):
            action = 0.1 * (count // 3)
            one.step(PERIOD * count, PERIOD, action=action)
            if share > 1:
                if count % 3 == 2:
                    other.step(PERIOD * (count - 2), 3 * PERIOD, action=action)
            else:
                parts = round(1 / share)
                for part in range(parts):
                    before = other.get(*SHOWN)
                    other.step(PERIOD * (count + part * share), PERIOD * share, action=action if part == 0 else 1.0)
                    assert (other.get(*SHOWN) == before) == (part < parts - 1)
            if share < 1 or count % 3 == 2:
                assert other.get(*SHOWN) == one.get(*SHOWN)


def test_a_surrogate_fmu_continues_from_a_saved_state(twin):
    with opened(twin) as one:
        one.begin({"upper": 0.2})
        driven(one, pumped(3))
        kept = one.fmu.getFMUState()
        content = one.fmu.serializeFMUState(kept)
        first = driven(one, pumped(5))
        one.fmu.setFMUState(kept)
        np.testing.assert_array_equal(driven(one, pumped(5)), first)
        one.fmu.setFMUState(one.fmu.deserializeFMUState(content))
        np.testing.assert_array_equal(driven(one, pumped(5)), first)
        one.fmu.freeFMUState(kept)


@pytest.mark.parametrize("action", [float("nan"), float("inf"), -0.1, 1.1])
def test_a_surrogate_fmu_refuses_an_input_beyond_its_limits(twin, action):
    said: list[str] = []
    with opened(twin, said) as one:
        one.begin()
        before = one.get(*SHOWN)
        with pytest.raises(FMICallException):
            one.step(0.0, PERIOD, action=action)
        assert one.get(*SHOWN) == before
    assert "limits of the variable: action" in said[0]


@pytest.mark.parametrize("level", [float("nan"), 1.5, -0.1])
def test_a_surrogate_fmu_refuses_a_start_state_outside_its_bounds(twin, level):
    said: list[str] = []
    with opened(twin, said) as one, pytest.raises(FMICallException):
        one.begin({"upper": level})
    assert "limits of the variable: upper" in said[-1]


def test_a_surrogate_fmu_refuses_setting_outputs_during_the_simulation(twin):
    with opened(twin) as one:
        one.begin()
        for name in ("upper", "reward"):
            with pytest.raises(FMICallException):
                one.set(name, 0.5)


def test_a_surrogate_fmu_can_be_used_as_an_original_environment(twin):
    """surrogym describe, doctor and sample open it like any other FMU."""
    environment = original.make(f"fmu:{twin}", spec=tanks().model_copy(update={"environment": f"fmu:{twin}"}))
    try:
        step = environment.step_from(np.array([0.3, 0.2]), np.array([0.5]))
    finally:
        environment.close()
    with opened(twin) as one:
        one.begin({"upper": 0.3, "lower": 0.2})
        one.step(0.0, PERIOD, action=0.5)
        assert step.next_coordinates.tolist() == one.get(*STATE)


def test_the_fmu_c_functions_match_the_official_fmi3_headers(surrogate, tmp_path):
    block = twin_of(surrogate)
    folder = Path(fmpy.__file__).parent / "c-code"
    (tmp_path / "block.h").write_text(block.header())
    wrapper = (Path(fmu.__file__).parent / "fmi3.c").read_text()
    (tmp_path / "fmi3.c").write_text('#include "fmi3Functions.h"\n' + wrapper)
    strict = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-Wno-unused-parameter", f"-I{folder}", "-fsyntax-only"]
    subprocess.run([COMPILER, *strict, "fmi3.c"], cwd=tmp_path, check=True)


def test_the_c_sources_in_a_surrogate_fmu_compile_without_warnings(twin, tmp_path):
    with zipfile.ZipFile(twin) as archived:
        archived.extractall(tmp_path)
    names = [n for n in os.listdir(tmp_path / "sources") if n.endswith(".c")]
    described = (tmp_path / "sources" / "buildDescription.xml").read_text()
    assert all(f'"{name}"' in described for name in names)
    strict = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-Wno-unused-parameter", "-fsyntax-only"]
    subprocess.run([COMPILER, *strict, *names], cwd=tmp_path / "sources", check=True)


def test_without_a_compiler_a_surrogate_fmu_contains_only_sources(surrogate, tmp_path, monkeypatch):
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr(c_compiler.shutil, "which", lambda _: None)
    written = write_twin(surrogate.to_bytes(), tmp_path / "tanks.fmu")
    assert written.binary is None
    assert validate_fmu(str(written.path)) == []
    with zipfile.ZipFile(written.path) as archived:
        assert not any(name.startswith("binaries") for name in archived.namelist())


def test_a_failing_compiler_leaves_the_earlier_fmu_file(surrogate, tmp_path, monkeypatch):
    monkeypatch.setenv("CC", "false")
    path = tmp_path / "tanks.fmu"
    path.write_bytes(b"earlier")
    with pytest.raises(c_compiler.CannotCompile):
        write_twin(surrogate.to_bytes(), path)
    assert path.read_bytes() == b"earlier"
    assert os.listdir(tmp_path) == ["tanks.fmu"]


@pytest.mark.skipif(shutil.which("arm-linux-gnueabihf-gcc") is None, reason="no compiler for another machine")
def test_a_compiler_for_another_architecture_is_refused_for_an_fmu(surrogate, tmp_path, monkeypatch):
    monkeypatch.setenv("CC", "arm-linux-gnueabihf-gcc")
    with pytest.raises(c_compiler.CannotCompile, match="for this machine"):
        write_twin(surrogate.to_bytes(), tmp_path / "tanks.fmu")
    assert os.listdir(tmp_path) == []


def test_the_instantiation_token_of_an_fmu_depends_on_surrogate_and_period(surrogate):
    assert twin_of(surrogate).token == twin_of(surrogate).token
    assert twin_of(surrogate, 5.0).token != twin_of(surrogate).token


@pytest.mark.parametrize(
    ("changes", "period", "said"),
    [
        ({"sampling_period": None}, None, "nor a sampling_period in the specification"),
        ({}, 0.0, "above 0, got 0.0"),
        ({}, float("nan"), "above 0, got nan"),
    ],
)
def test_a_surrogate_fmu_with_an_invalid_period_is_refused(surrogate, changes, period, said):
    file = replace(surrogate, spec=surrogate.spec.model_copy(update=changes))
    with pytest.raises(InvalidInput, match=said):
        twin_of(file, period)


def test_exporting_an_fmu_of_a_model_family_without_c_export_is_refused(tmp_path):
    spec = EnvironmentSpec.model_validate(
        tanks().model_dump() | {"design": {"model": {"name": "ensemble", "settings": {"members": 2, "steps": 1}}}}
    )
    with pytest.raises(InvalidInput, match="gaussian_process or sparse_gaussian_process, got 'ensemble'"):
        twin_of(exported("tanks", spec, drained(24)))


def test_exporting_an_fmu_of_a_model_with_a_prior_is_refused(surrogate):
    model, prior = (from_bytes(stored_definition(surrogate.spec), surrogate.model) for _ in range(2))
    with pytest.raises(InvalidInput, match="expected a model without a prior"):
        twin_of(replace(surrogate, model=to_bytes(replace(model, prior=prior))))


def test_the_command_writes_the_fmu_of_a_surrogate_file(surrogate, tmp_path, capsys, monkeypatch):
    surrogym = speaker(main, capsys, monkeypatch, tmp_path)
    (tmp_path / "tanks.surrogate").write_bytes(surrogate.to_bytes())
    command = ("deploy", "tanks.surrogate", "--target", "fmu", "--out")
    (written,) = surrogym(*command, "twin", "--json").json["files"]
    assert validate_fmu(written) == []
    (tmp_path / "twin" / "other.txt").write_text("kept")
    said = surrogym(*command, "twin")
    assert (said.code, "with other files" in said.err) == (1, True)
    said = surrogym(*command, "new", "--period", "0")
    assert (said.code, "above 0, got 0" in said.err) == (1, True)
    assert not (tmp_path / "new").exists()
    for other in (
        [*command, "new", "--check"],
        [*command, "new", "--fallback", "0"],
    ):
        said = surrogym(*other)
        assert (said.code, "only --out and --period" in said.err) == (1, True)
