"""Processes of a demo end with it, with all that they started, and one that fails is named with its last words."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from surrogym.demo.processes import Child, Children, RunFailed, await_file

STUBBORN = """
import os, signal, subprocess, sys, time
signal.signal(signal.SIGTERM, signal.SIG_IGN)
below = subprocess.Popen(["sleep", "3600"])
with open(sys.argv[1] + ".new", "w") as file:
    file.write(str(below.pid))
os.rename(sys.argv[1] + ".new", sys.argv[1])
time.sleep(3600)
"""
FAILING = "print('no licence', flush=True); raise SystemExit(7)"


@pytest.fixture
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], str]:
    """Makes a module that can be started by its name."""
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))

    def make(text: str) -> str:
        (tmp_path / "some_program.py").write_text(text)
        return "some_program"

    return make


def lives(pid: int) -> bool:
    """Whether a process runs; one that has ended may still be in the list of processes."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.mark.parametrize("error", [ZeroDivisionError, KeyboardInterrupt])
def test_the_demo_ends_child_processes_that_ignore_signals_and_their_descendants(
    tmp_path: Path, program: Callable[[str], str], monkeypatch: pytest.MonkeyPatch, error: type[BaseException]
):
    monkeypatch.setattr("surrogym.demo.processes.STOPPING_SECONDS", 0.5)
    started: list[int] = []

    def run() -> None:
        with Children(tmp_path) as children:
            child = children.start("trainer", program(STUBBORN), [str(tmp_path / "ready")])
            started.extend((child.process.pid, int(await_file(child, tmp_path / "ready"))))
            assert all(map(lives, started))
            raise error

    with pytest.raises(error):
        run()
    until(lambda: not any(map(lives, started)))


SAVING = """
import signal, sys, time
from pathlib import Path

def save(*_):
    time.sleep(0.1)
    Path(sys.argv[1] + ".saved").touch()
    raise SystemExit

signal.signal(signal.SIGTERM, save)
Path(sys.argv[1]).write_text("ready")
time.sleep(3600)
"""


def test_a_stubborn_child_process_takes_no_time_from_the_server_to_save(
    tmp_path: Path, program: Callable[[str], str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("surrogym.demo.processes.STOPPING_SECONDS", 1.5)
    with Children(tmp_path) as children:
        server = children.start("server", program(SAVING), [str(tmp_path / "server")])
        await_file(server, tmp_path / "server")
        sampler = children.start("sampler", program(STUBBORN), [str(tmp_path / "sampler")])
        await_file(sampler, tmp_path / "sampler")
    assert (tmp_path / "server.saved").exists()


def failed(children: Children, child: Child) -> str:
    """Return the message of the error that a failed process causes."""
    until(lambda: child.process.poll() is not None)
    with pytest.raises(RunFailed) as said:
        children.check()
    return str(said.value)


def test_the_demo_reports_a_failed_child_process_with_its_last_output(tmp_path: Path, program: Callable[[str], str]):
    with Children(tmp_path) as children:
        child = children.start("trainer", program(FAILING), [])
        log = tmp_path / "trainer.log"
        assert failed(children, child) == f"the trainer ended with exit code 7: no licence (log: {log})"
        with pytest.raises(RunFailed, match="the trainer did not start: no licence"):
            await_file(child, tmp_path / "never")


def test_the_demo_names_a_killed_child_process(tmp_path: Path, program: Callable[[str], str]):
    with Children(tmp_path) as children:
        child = children.start("server", program(STUBBORN), [str(tmp_path / "ready")])
        await_file(child, tmp_path / "ready")
        os.kill(child.process.pid, signal.SIGKILL)
        assert "the server ended with exit code -9" in failed(children, child)
