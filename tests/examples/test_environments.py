"""The environments of examples/ run in short: registered, sampled, and where it says so trained on and evaluated."""

from __future__ import annotations

import json
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

from support.examples import EXAMPLES, cells, run, surrogym
from support.server import ServerProcess
from surrogym import Design
from surrogym_client.transport import Api
from surrogym_sampler.original import OriginalEnvironment, make
from surrogym_sampler.original.protocol import RolloutEnvironment

ENVIRONMENT_LINES = 60  # of one's own environment, without blank ones


def test_the_drone_example_can_be_learned_trained_on_and_evaluated(server: ServerProcess, tmp_path: Path) -> None:
    surrogym(server, tmp_path, "register", "drone:Drone", "--name", "drone", "--budget", "10", "--initial", "10")
    report = surrogym(server, tmp_path, "sample", "drone", "--env", "drone:Drone", "--until-done", "--json")
    assert json.loads(report)["steps"] == 10
    surrogym(server, tmp_path, "train", "drone", "--steps", "2048", "--num-envs", "16", "--out", "drone.zip")
    evaluated = surrogym(server, tmp_path, "evaluate", "drone.zip", "--env", "drone:Drone", "--episodes", "2", "--json")
    assert json.loads(evaluated)["episodes"] == 2


def test_the_drone_example_is_as_short_as_the_docs_say() -> None:
    lines = (EXAMPLES / "drone.py").read_text(encoding="utf-8").splitlines()
    assert sum(bool(line) for line in lines) <= ENVIRONMENT_LINES


def test_four_samplers_share_the_queries_of_the_slow_simulator_example(server: ServerProcess, tmp_path: Path) -> None:
    surrogym(
        server, tmp_path, "register", "slow_simulator:SlowPendulum", "--name", "slow", "--budget", "8", "--initial", "8"
    )
    said = run(server, tmp_path, str(EXAMPLES / "slow_simulator.py"), "slow", SIMULATOR_SECONDS="0.5")
    assert said.splitlines()[-1].startswith("4 samplers, 0 failed")
    with Api(server.url) as api:
        workers = [sample.sampler for sample in api.samples("slow")]
    assert len(workers) == 8
    assert len(set(workers)) >= 2


def test_the_reset_only_robot_example_can_be_sampled(server: ServerProcess, tmp_path: Path) -> None:
    surrogym(server, tmp_path, "register", "robot:Joint", "--name", "joint", "--budget", "14")
    report = surrogym(
        server, tmp_path, "sample", "joint", "--env", "robot:Joint", "--until-done", "--json", ROBOT_PERIOD="0"
    )
    assert 12 <= json.loads(report)["steps"] <= 14


def test_a_policy_trained_on_the_surrogate_of_an_fmu_controls_the_fmu(server: ServerProcess, tmp_path: Path) -> None:
    pytest.importorskip("fmpy")
    pytest.importorskip("pythonfmu")
    program = [str(EXAMPLES / "fmus" / "control.py"), "TwoTanks", "--budget", "10", "--steps", "2048"]
    said = run(server, tmp_path, *program, "--episodes", "2", "--baseline", "2048")
    assert "after 10 real steps" in said
    assert said.splitlines()[-1].startswith("from the surrogate")


def test_the_fmu_example_without_the_lab_says_what_its_baseline_needs(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    program = str(EXAMPLES / "fmus" / "control.py")
    monkeypatch.setitem(sys.modules, "surrogym_lab", None)  # as in an installed wheel
    monkeypatch.setattr(sys, "argv", [program, "TwoTanks", "--baseline", "10"])
    with pytest.raises(SystemExit):
        runpy.run_path(program, run_name="__main__")
    assert "error: --baseline needs surrogym_lab, which is in a clone only" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["bump:Bump", "noisy_mass:NoisyMass"])
def test_example_environments_of_the_decision_pages_take_a_step(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(EXAMPLES)
    environment = make(name)
    assert isinstance(environment, OriginalEnvironment)
    spec = environment.spec()
    q, u = np.full(len(spec.coordinates), 0.5), np.ones(spec.action.size)
    first, second = (np.asarray(environment.step_from(q, u).next_coordinates) for _ in range(2))
    assert np.abs(first - q).max() > 0.02
    assert (first == second).all() == (name == "bump:Bump"), "noise alone differs"


@pytest.mark.parametrize(("name", "history"), [("dead_time:Vessel", 4), ("hidden_speed:AngleAlone", 1)])
def test_example_environments_with_lagged_dynamics_are_learned(
    name: str, history: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(EXAMPLES)
    machine = make(name)
    assert isinstance(machine, RolloutEnvironment)
    design = Design(machine.spec(), budget=60)
    while (query := design.ask()) is not None:
        machine.begin(seed=query.id)
        design.tell(query, [machine.act(np.array(action)) for action in query.actions])
    assert design.phase == "ready"
    (moved,) = design.surrogate().model.transitions
    assert moved.feature_map.history in (None, history), "None: all that are declared"


def test_every_cell_of_the_example_notebook_runs(server: ServerProcess, tmp_path: Path) -> None:
    run(server, tmp_path, "-W", "error", "-c", cells(EXAMPLES / "first_steps.ipynb"))
