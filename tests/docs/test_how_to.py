"""The programs on the how-to pages run as they stand, each in a process of its own, against a real server."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from support.server import ServerProcess

PAGES = Path(__file__).parents[2] / "docs" / "how-to"
PRINTED_URL = "http://127.0.0.1:8000"
READERS_FUNCTIONS = (
    "read_sensors, send = lambda: [1.0, 0.0, 0.0], lambda action: None\n"  # that files-and-terminal.md leaves to them
)
READERS_CART = """
from surrogym import BoxAction, Coordinate, EnvironmentSpec, ObservationEntry, Term, Uniform
cart = EnvironmentSpec(
    coordinates=(Coordinate(name="x", sampling=Uniform(low=-1, high=1)),),
    observation=(ObservationEntry(name="x", term=Term.linear(x=1)),),
    action=BoxAction(low=(-1,), high=(1,)),
    start={"x": Uniform(low=-0.1, high=0.1)},
    time_limit=100,
    sampling_period=0.05,
    query="rollout",
)
"""  # that limits.md leaves to them


def programs(page: str) -> list[str]:
    text = (PAGES / page).read_text(encoding="utf-8")
    return re.findall(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


def run(folder: Path, *arguments: str) -> str:
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    command = [sys.executable, *arguments]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("number", [0, 1])
def test_the_how_to_program_for_stepping_a_surrogate_runs(server: ServerProcess, tmp_path: Path, number: int) -> None:
    run(tmp_path, "-c", programs("trainers.md")[number].replace(PRINTED_URL, server.url))


def test_the_how_to_program_for_training_with_another_algorithm_runs(server: ServerProcess, tmp_path: Path) -> None:
    program = programs("trainers.md")[2]
    run(tmp_path, "-c", program.replace(PRINTED_URL, server.url).replace("10_000", "500"))
    assert (tmp_path / "mine.zip").exists()
    improve = ["improve", "pendulum", "--queries", "1", "--checkpoint", "after-10k-steps", "--json"]
    view = json.loads(run(tmp_path, "-m", "surrogym", *improve, "--server", server.url))
    assert view["budget"] == 7


def test_the_how_to_program_for_stepping_a_surrogate_file_runs(server: ServerProcess, tmp_path: Path) -> None:
    on_server = ["--server", server.url]
    run(tmp_path, "-m", "surrogym", "export", "pendulum", "--out", "pendulum.surrogate", *on_server)
    run(tmp_path, "-m", "surrogym", "import", "pendulum.surrogate", "--name", "pendulum-2", *on_server)
    for program in programs("in-process.md")[2:]:
        run(tmp_path, "-c", program.replace(PRINTED_URL, server.url).replace("10_000", "512"))


def test_the_how_to_program_for_filming_an_episode_runs(server: ServerProcess, tmp_path: Path) -> None:
    film, own = programs("policies.md")[-2:]
    run(tmp_path, "-c", film.replace(PRINTED_URL, server.url))
    assert [video.stat().st_size > 0 for video in (tmp_path / "videos").glob("*.mp4")] == [True]
    run(tmp_path, "-c", f"{own}\nassert Cart().picture([0.5])[30, 140].tolist() == [200, 60, 20]")


def test_the_commands_of_the_terminal_how_to_page_run(
    server: ServerProcess, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SURROGYM_URL", server.url)
    text = (PAGES / "files-and-terminal.md").read_text(encoding="utf-8")
    lines = re.findall(r"^surrogym (.*)$", "".join(re.findall(r"```console\n(.*?)```", text, re.DOTALL)), re.MULTILINE)
    assert len(lines) > 6
    for line in lines:
        if not {"--watch", "train", "export-policy", "import"} & set(line.split()):  # other tests run them
            run(tmp_path, "-m", "surrogym", *line.split())
    assert (tmp_path / "report.html").exists()


@pytest.mark.timeout(900)  # on a machine that others use as well
def test_the_how_to_program_for_exporting_a_policy_runs(server: ServerProcess, tmp_path: Path) -> None:
    train = ["train", "pendulum", "--steps", "512", "--num-envs", "16", "--quiet", "--server", server.url]
    run(tmp_path, "-m", "surrogym", *train)
    for file in ("policy.onnx", "policy.pt2"):
        run(tmp_path, "-m", "surrogym", "export-policy", "policy.zip", "--out", file)
    (program,) = programs("files-and-terminal.md")
    run(tmp_path, "-c", READERS_FUNCTIONS + program)
    evaluate = ["evaluate", "policy.onnx", "--env", "Pendulum-v1", "--episodes", "2", "--json", "--server", server.url]
    assert json.loads(run(tmp_path, "-m", "surrogym", *evaluate))["episodes"] == 2


def test_the_how_to_program_for_a_reset_only_environment_runs(server: ServerProcess, tmp_path: Path) -> None:
    program, _ = programs("no-teleport.md")
    (tmp_path / "wagon.py").write_text(program, encoding="utf-8")
    common = ["--server", server.url, "--json", "--quiet"]
    run(tmp_path, "-m", "surrogym", "register", "wagon:Wagon", "--name", "wagon", "--budget", "14", *common)
    sample = ["sample", "wagon", "--env", "wagon:Wagon", "--until-done"]
    report = json.loads(run(tmp_path, "-m", "surrogym", *sample, *common))
    assert report["failed"] == 0
    assert 12 <= report["steps"] <= 14


def test_the_how_to_program_for_a_design_with_snapshots_runs(tmp_path: Path) -> None:
    _, program = programs("no-teleport.md")
    steps, phase = run(tmp_path, "-c", program).split()
    assert (int(steps) <= 100, phase) == (True, "ready")


def test_the_how_to_program_for_a_user_defined_environment_runs(server: ServerProcess, tmp_path: Path) -> None:
    (program,) = programs("own-environment.md")
    (tmp_path / "rail.py").write_text(program, encoding="utf-8")
    common = ["--server", server.url, "--json", "--quiet"]
    run(tmp_path, "-m", "surrogym", "register", "rail:Rail", "--name", "rail", "--budget", "5", *common)
    sample = ["sample", "rail", "--env", "rail:Rail", "--until-done"]
    report = json.loads(run(tmp_path, "-m", "surrogym", *sample, *common))
    assert (report["answered"], report["failed"]) == (5, 0)


def test_the_how_to_commands_for_drafting_and_importing_a_log_run(server: ServerProcess, tmp_path: Path) -> None:
    (program,) = programs("logs.md")
    said = run(tmp_path, "-c", program.replace(PRINTED_URL, server.url))
    assert said.endswith("400 steps, 0 rows set aside\n")


def test_the_how_to_program_for_learned_rewards_and_terminations_runs(server: ServerProcess, tmp_path: Path) -> None:
    (tmp_path / "track.py").write_text(programs("rewards-and-terminations.md")[0], encoding="utf-8")
    common = ["--server", server.url, "--json", "--quiet"]
    run(tmp_path, "-m", "surrogym", "register", "track:Track", "--name", "track", "--budget", "6", *common)
    sample = ["sample", "track", "--env", "track:Track", "--until-done"]
    report = json.loads(run(tmp_path, "-m", "surrogym", *sample, *common))
    assert (report["answered"], report["failed"]) == (6, 0)
    for program in programs("rewards-and-terminations.md")[1:]:
        run(tmp_path, "-c", program)


def test_the_how_to_program_for_a_policy_with_lagged_inputs_runs(tmp_path: Path) -> None:
    machine, own_program = programs("history.md")
    (tmp_path / "tank.py").write_text(machine, encoding="utf-8")
    run(tmp_path, "-c", f"{own_program}\nassert abs(reading - 1) < 0.1, reading")


def test_the_how_to_program_for_actions_that_change_slowly_declares_their_largest_change(tmp_path: Path) -> None:
    (program,) = programs("limits.md")
    told = "from surrogym_shared.rates import rates\nprint(rates(smooth)[0].change)"
    said = run(tmp_path, "-c", f"{READERS_CART}\n{program}\n{told}")
    assert float(said) == pytest.approx(0.2)


def test_the_how_to_program_for_contacts_calibrates_and_trains_in_the_simulator(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    (program,) = programs("contacts.md")
    small = "from surrogym_trainer.training import checks\nchecks.CHECK_EPISODES = 1\n"
    short = program.replace("3_000_000", "1").replace("range(2)", "range(1)").replace('limit": 500', 'limit": 5')
    values, policy = run(tmp_path, "-c", small + short).splitlines()
    assert "'gear.bthigh': 119.99" in values
    assert policy.startswith("gait-0.zip ")


def test_the_how_to_program_for_a_simulator_prior_runs(tmp_path: Path) -> None:
    plant, program = programs("priors.md")
    (tmp_path / "arm.py").write_text(plant)
    phase, steps, _ = run(tmp_path, "-c", program).split(maxsplit=2)
    assert phase == "ready"
    assert int(steps) < 27  # without a prior
