"""Processes of cells: they pass their rounds on, one that dies ends no other, and none outlives its parent."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from surrogym_lab.peers.points import TIME, Point
from surrogym_lab.peers.processes import run_cells
from surrogym_lab.peers.study import PeerCell
from surrogym_sampler.original.errors import UnknownEnvironment

PATIENCE = 60.0
OWN = """
import os, pathlib, time

def dies():
    os._exit(3)

def hangs():
    pathlib.Path("partial").write_text(str(os.getpid()))
    os.replace("partial", "pid")
    time.sleep(600)
"""

pytestmark = pytest.mark.slow


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the module ``peers_own``, which processes find."""
    (tmp_path / "peers_own.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def wait_for(what: str, happened) -> None:
    deadline = time.monotonic() + PATIENCE
    while not happened():
        assert time.monotonic() < deadline, f"still waiting for {what}"
        time.sleep(0.05)


def gone(pid: int) -> bool:
    """Whether a process has ended. One that nobody waits for stays as a zombie."""
    stat = Path(f"/proc/{pid}/stat")
    return not stat.exists() or stat.read_text().rpartition(")")[2].split()[0] == "Z"


def test_a_dying_comparison_process_does_not_affect_the_others(own: Path):
    """A cell may take 90 minutes, and a user waits for its first word."""
    dying, cell = PeerCell("peers_own:dies", "ppo", 0), PeerCell("cartpole", "ppo", 0, episodes=1, minutes=-1.0)
    rounds: list[tuple[PeerCell, int]] = []
    told: dict[PeerCell, list[Point]] = {}
    run_cells([dying, cell], own, 1, told.__setitem__, lambda cell, point: rounds.append((cell, point.round)))
    assert [point.ended for point in told[dying]] == ["RuntimeError: its process ended with exit code 3"]
    assert dying.points(own) == told[dying]
    assert not dying.done(own)
    assert [point.ended for point in told[cell]] == [TIME]
    assert cell.done(own)
    assert rounds == [(cell, 1)]


def test_an_error_in_one_comparison_run_ends_the_others_and_is_reported(own: Path, capfd: pytest.CaptureFixture[str]):
    def told(cell: PeerCell, points: list[Point]) -> None:
        raise AssertionError(points)

    hanging, unknown = PeerCell("peers_own:hangs", "ppo", 0), PeerCell("peers_own:Nope", "ppo", 0)
    with pytest.raises(UnknownEnvironment, match="has no attribute 'Nope'"):
        run_cells([hanging, unknown], own, 2, told)
    pid = own / "pid"
    assert not pid.exists() or gone(int(pid.read_text()))
    assert "Traceback" not in capfd.readouterr().err


def test_a_comparison_run_ends_with_its_parent_process(own: Path):
    """It went on for 90 minutes after kill -9, and wrote its file beside that of the next command."""
    code = """
from pathlib import Path
from surrogym_lab.peers.processes import run_cells
from surrogym_lab.peers.study import PeerCell
run_cells([PeerCell("peers_own:hangs", "ppo", 0)], Path("."), 1, print)
"""
    with subprocess.Popen([sys.executable, "-c", code]) as parent:
        wait_for("the cell", (own / "pid").exists)
        os.kill(parent.pid, signal.SIGKILL)
    pid = int((own / "pid").read_text())
    wait_for("its end", lambda: gone(pid))
