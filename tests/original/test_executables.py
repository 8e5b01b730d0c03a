"""A program that dies, hangs or prints nonsense costs one step, and the next step starts it anew."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
import sys
import time
from pathlib import Path
from subprocess import PIPE

import numpy as np
import pytest

from support.noting import until
from support.programs import FALLS_BACK, HANGS, KEEPS_LIMITS, NOTES_ITSELF, UNTERMINABLE, left_behind, program
from surrogym_sampler import original
from surrogym_sampler.original.classic import cartpole
from surrogym_sampler.original.errors import EnvironmentDied, StepFailed, StepTimedOut, UnknownEnvironment
from surrogym_sampler.original.executables import name_of
from surrogym_sampler.original.executables.messages import CHECK, decode
from surrogym_sampler.original.executables.program import Program
from surrogym_sampler.original.loading import is_known
from surrogym_shared.spec import with_history

SHELL = Path(__file__).parents[2] / "examples" / "executables" / "rail.sh"
MOODY = """
import json, os, sys, time
from surrogym_sampler.original.classic import cartpole
for line in sys.stdin:
    asked = json.loads(line)
    result = {"state": asked.get("state", [0, 0, 0, 0])}
    if asked["method"] == "spec":
        result = {"protocol": VERSION, "spec": cartpole().model_dump(mode="json")}
    if asked["method"] == "save":
        result = {"snapshot": "s" * 2**20}
    if asked["method"] == "restore":
        result = {"state": [len(asked["snapshot"]), 0, 0, 0]}
    if asked["method"] == "step":
        MOOD
        result |= {"reward": os.getpid(), "terminated": False, "truncated": False}
    print(json.dumps({"id": asked["id"], "result": result}), flush=True)
    if asked["method"] == "close":
        break
"""


def moody(mood: str, version: int = 1, step_limit: float = 30.0, spec=None):
    """A program that does ``mood`` at action 1."""
    code = MOODY.replace("MOOD", f"if asked['action'] == [1]: {mood}").replace("VERSION", str(version))
    return original.make(f"exec:{shlex.join([sys.executable, '-c', code])}", step_limit=step_limit, spec=spec)


def test_a_command_with_the_prefix_of_its_environment_name_names_the_same_program():
    assert name_of("exec:sh rail.sh") == name_of("sh rail.sh") == "exec:sh rail.sh"


def test_an_environment_program_written_in_shell_returns_the_exact_next_states():
    plant = original.make(f"exec:{shlex.quote(str(SHELL))}")
    step = plant.step_from(np.array([7.0]), np.array([1.0]))
    plant.close()
    assert (list(step.coordinates), list(step.next_coordinates), step.reward) == ([7.0], [8.0], -64.0)


@pytest.mark.parametrize(
    ("mood", "message"),
    [
        ("os._exit(7)", "exit code 7 during step"),
        ("print('hello', flush=True)", "one line of JSON from the program, got hello"),
        ("print(flush=True)", "one line of JSON from the program, got an empty line; let it print"),
        ("result = {'state': [0]}", "4 finite numbers"),
        ("result = {}", "4 finite numbers for 'state' in the program's answer, got nothing;"),
        ("result['state'][3] = float('-inf')", "expected finite numbers from the program, got -Infinity in"),
        ("os.close(1); time.sleep(60)", "the program closed its standard output and was ended during step$"),
    ],
)
def test_a_fault_of_an_environment_program_costs_one_step(mood, message):
    plant = moody(mood)
    try:
        with pytest.raises(StepFailed, match=message):
            plant.step_from(np.zeros(4), np.ones(1))
        assert plant.step_from(np.zeros(4), np.zeros(1)).reward > 0
    finally:
        plant.close()


def test_a_hanging_environment_program_is_killed_and_restarted():
    plant = moody("time.sleep(3600)", step_limit=5.0)
    try:
        before = int(plant.step_from(np.zeros(4), np.zeros(1)).reward)
        with pytest.raises(StepTimedOut, match="did not answer step"):
            plant.step_from(np.zeros(4), np.ones(1))
        with pytest.raises(ProcessLookupError):
            os.kill(before, 0)
        assert int(plant.step_from(np.zeros(4), np.zeros(1)).reward) != before
    finally:
        plant.close()


def test_the_error_for_an_unterminated_output_line_shows_it_with_a_remedy():
    plant = moody("sys.stdout.write('{\"id\": 3'); sys.stdout.flush(); time.sleep(3600)", step_limit=2.0)
    try:
        with pytest.raises(StepTimedOut, match=r'printed {"id": 3 without an end of the line; a larger --step-limit'):
            plant.step_from(np.zeros(4), np.ones(1))
    finally:
        plant.close()


@pytest.mark.parametrize(
    ("error", "said"),
    [
        ("no\n\x1b[2Jlicence", "the program answered: no [2Jlicence"),
        ("E" * 10**6, f"the program answered: {'E' * 400}…"),
        ("", "the program answered: an error without words"),
        (None, f"expected 'result' or 'error' in the program's answer, got {{\"id\": 1, \"error\": null}}; {CHECK}"),
    ],
)
def test_the_error_of_an_environment_program_is_repeated_in_one_short_line(error, said):
    with pytest.raises(StepFailed) as raised:
        decode(json.dumps({"id": 1, "error": error}).encode(), 1)
    assert str(raised.value) == said


def test_a_program_reply_with_error_null_and_a_result_is_accepted():
    assert decode(b'{"id": 1, "error": null, "result": {"state": [0]}}', 1) == {"state": [0]}


def test_child_processes_of_a_killed_environment_program_are_killed_too(tmp_path):
    plant = f"sh -c 'sleep 3600 >/dev/null & echo $! > {tmp_path}/pids; exit 3'"
    with pytest.raises(UnknownEnvironment, match="got none"):
        original.make(f"exec:{plant}")
    assert left_behind(tmp_path) == []


def test_the_error_of_a_failed_program_contains_its_last_stderr_line(capfd: pytest.CaptureFixture[str]):
    plant = moody("print('no licence\\x1b[2J\\n', file=sys.stderr, flush=True); os.abort()")
    try:
        with pytest.raises(
            StepFailed, match=r"exit code -6 \(SIGABRT\) during step; .* standard error: no licence\[2J$"
        ):
            plant.step_from(np.zeros(4), np.ones(1))
    finally:
        plant.close()
    assert "no licence" in capfd.readouterr().err


def test_much_output_on_stderr_does_not_block_an_environment_program(monkeypatch: pytest.MonkeyPatch):
    """This process's own standard error is a pipe that nobody reads."""
    reading, writing = os.pipe()
    monkeypatch.setattr("surrogym_sampler.original.executables.program.OWN", writing)
    plant = moody("[print('x' * 10**6, file=sys.stderr) for _ in range(30)]")
    try:
        assert plant.step_from(np.zeros(4), np.ones(1)).reward > 0
        assert len(plant._program._standard_error._tail) <= 4096
    finally:
        plant.close()
        os.close(reading)
        os.close(writing)


def test_a_large_snapshot_of_an_environment_program_is_restored():
    plant = moody("pass")
    try:
        plant.begin()
        assert plant.restore(plant.save())[0] == 2**20
    finally:
        plant.close()


def test_lags_are_computed_for_a_program_that_declares_none():
    largest = {"x": 2.0, "velocity": 1.0, "pole": 1.0, "omega": 1.0}
    spec = with_history(cartpole().model_copy(update={"query": "rollout"}), changes=1, actions=1, largest=largest)
    plant = moody("result['state'] = [0.5, 0, 0, 0]", spec=spec)
    try:
        assert plant.begin(0).tolist() == [0.0] * 9
        assert plant.act(np.ones(1)).next_coordinates.tolist() == [0.5, 0, 0, 0, 0.5, 0, 0, 0, 1]
        saved = plant.save()
        assert plant.act(np.zeros(1)).next_coordinates.tolist() == [0, 0, 0, 0, -0.5, 0, 0, 0, 0]
        assert plant.restore(saved).tolist() == [2**20, 0, 0, 0, 0.5, 0, 0, 0, 1]
        with pytest.raises(StepFailed, match="expected a snapshot of at least 72 bytes"):
            plant.restore(b"short")
    finally:
        plant.close()


def test_an_environment_program_that_does_not_read_its_input_is_killed():
    sleeper = Program("sleep 3600")
    sleeper.start()
    with pytest.raises(StepTimedOut, match=r"read only \d+ of 1048576 bytes of restore within 0.2 s and was ended"):
        sleeper.exchange(b"s" * 2**20, "restore", time.monotonic() + 0.2)
    assert not sleeper.running


def test_a_program_with_a_newer_protocol_version_is_refused_with_a_remedy():
    with pytest.raises(UnknownEnvironment, match="expected protocol 1 from the program, got 2: update surrogym"):
        moody("pass", version=2)


def test_a_specification_from_a_server_never_starts_a_program():
    assert not is_known("exec:./plant")


def test_a_late_program_reply_is_never_taken_for_the_reply_to_another_request(tmp_path):
    late = ("    [u] = ", "    [u] = [0.0] if request['action'] == [1.0] and not time.sleep(1.0) else ")
    plant = original.make(f"exec:{program(tmp_path, late)}", step_limit=0.5)
    try:
        with pytest.raises(StepTimedOut):
            plant.step_from(np.array([0.7]), np.ones(1))
        time.sleep(1.0)
        assert plant.step_from(np.array([0.2]), np.zeros(1)).reward == -0.2
    finally:
        plant.close()


def test_an_environment_program_ends_if_the_process_that_started_it_is_killed(tmp_path):
    name = f"exec:{program(tmp_path, NOTES_ITSELF)}"
    client = f"import time; from surrogym_sampler import original; plant = original.make({name!r}); time.sleep(3600)"
    process = subprocess.Popen([sys.executable, "-c", client])
    try:
        assert until(lambda: (tmp_path / "pids").exists() and (tmp_path / "pids").read_text())
    finally:
        process.kill()
        process.wait()
    assert left_behind(tmp_path) == []


def test_the_fallback_of_a_program_with_limits_acts_longer_than_a_step_after_its_client_is_killed(tmp_path):
    slow = (FALLS_BACK[0], FALLS_BACK[1].replace("steps, before", "time.sleep(3); steps, before"))
    notes = ('print(json.dumps({"fallback": steps}), flush=True)', "open(os.path.dirname(__file__) + '/rests', 'x')")
    name = f"exec:{program(tmp_path, NOTES_ITSELF, KEEPS_LIMITS, ('0.005', '0.05'), slow, notes)}"
    client = f"from surrogym_sampler import original; original.make({name!r}, step_limit=0.01); print(1, flush=True); "
    with subprocess.Popen([sys.executable, "-c", f"{client}input()"], stdin=PIPE, stdout=PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"1\n"
        process.kill()
    assert left_behind(tmp_path) == []
    assert (tmp_path / "rests").exists()


@pytest.mark.parametrize("fault", ["time.sleep(1.0)", "print('warm', flush=True)"])
def test_a_program_with_limits_falls_back_before_it_is_ended_for_a_late_or_wrong_reply(tmp_path, fault):
    late = ("    [u] = ", f"    request['action'] == [1.0] and {fault}; [u] = ")
    notes = ('print(json.dumps({"fallback": steps}), flush=True)', "open(os.path.dirname(__file__) + '/rests', 'x')")
    plant = original.make(f"exec:{program(tmp_path, KEEPS_LIMITS, FALLS_BACK, late, notes)}", step_limit=0.5)
    try:
        with pytest.raises(StepFailed):
            plant.step_from(np.array([0.2]), np.ones(1))
        assert (tmp_path / "rests").exists()
    finally:
        plant.close()


def test_an_environment_program_that_hangs_ends_if_the_process_that_started_it_is_killed(tmp_path):
    """It reads nothing, so the end of its input says nothing to it, and SIGTERM does not end it."""
    hangs = (HANGS[0], "    open(os.path.dirname(__file__) + '/hangs', 'x')\n" + HANGS[1])
    command = program(tmp_path, NOTES_ITSELF, UNTERMINABLE, hangs)
    client = f"""
import time
from surrogym_sampler.original.executables.messages import CHECK, decode
from surrogym_sampler.original.executables.program import Program
plant = Program({command!r}, grace=0.0)
plant.start()
plant.ask("step", time.monotonic() + 3600, action=[1.0])
"""
    process = subprocess.Popen([sys.executable, "-c", client])
    try:
        assert until(lambda: (tmp_path / "hangs").exists())
    finally:
        process.kill()
        process.wait()
    assert left_behind(tmp_path) == []


def test_a_program_that_cannot_be_restarted_is_not_blamed_on_the_snapshot(tmp_path):
    """So the sampler keeps the snapshot that a query began at."""
    rail = tmp_path / "rail.sh"
    shutil.copy(SHELL, rail)
    rail.chmod(0o755)
    plant = original.make(f"exec:{shlex.quote(str(rail))}")
    try:
        snapshot = (plant.begin(), plant.save())[1]
        plant._program.end()
        rail.unlink()
        with pytest.raises(EnvironmentDied, match="could not be started anew"):
            plant.restore(snapshot)
    finally:
        plant.close()


def test_a_program_reply_with_a_repeated_key_is_refused():
    with pytest.raises(StepFailed, match=r"each key once .* 'reward' twice"):
        decode(b'{"id": 1, "result": {"reward": 1, "reward": 2}}', 1)
