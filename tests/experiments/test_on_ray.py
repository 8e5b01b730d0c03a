"""Cells in a real Ray cluster of this machine: rows, logs and run folders come back."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import pytest

from support.studies import ignore, stand_in
from surrogym_client.experiments.reproduce.cells import Cell, cells, done_already, run_cells
from surrogym_client.experiments.reproduce.on_ray import RayRun
from surrogym_client.experiments.reproduce.rows import read_rows
from surrogym_client.runtime import ray_cluster
from surrogym_client.runtime.ray_cluster import NoCluster, connect

ray = pytest.importorskip("ray")

PATIENCE = 60.0

pytestmark = [pytest.mark.timeout(600), pytest.mark.filterwarnings("ignore::FutureWarning:ray")]


def test_cells_run_in_the_cluster_and_leave_the_same_as_here(address: str, tmp_path: Path):
    connect(address)
    todo = list(cells(["pendulum"], ["default"], range(3)))
    here = run_cells(todo, [], tmp_path / "here", 2, ignore, stand_in(fails={1}))
    there = run_cells(todo, [], tmp_path / "there", 2, ignore, stand_in(fails={1}), RayRun)
    assert there == here
    assert [row.error for row in there] == ["", "exit code 1: error: no luck", ""]
    assert read_rows(tmp_path / "there" / "rows.csv") == there
    files = [
        {str(path.relative_to(root)) for path in root.rglob("*")} for root in map(tmp_path.joinpath, ("here", "there"))
    ]
    assert files[1] == files[0]
    left = [cell for cell in todo if not done_already(cell, there)]
    again = run_cells(left, there, tmp_path / "there", 1, ignore, stand_in(), RayRun)
    assert not any(row.error for row in again)


def test_an_interruption_ends_runs_in_the_cluster(address: str, tmp_path: Path):
    """The run ends with the process that started it, as a demo does."""
    connect(address)
    mark = tmp_path / "mark"
    script = (
        "import os, pathlib, sys, time; parent = os.getppid(); "
        f"pathlib.Path({str(mark)!r}).write_text(str(os.getpid()))\n"
        "while os.getppid() == parent: time.sleep(0.05)"
    )

    def interrupt(progress: object) -> None:
        if mark.exists() and mark.read_text():
            raise KeyboardInterrupt

    def command(cell: Cell, run: Path) -> list[str]:
        return [sys.executable, "-c", script]

    with pytest.raises(KeyboardInterrupt):
        run_cells(list(cells(["pendulum"], ["default"], [0])), [], tmp_path, 1, interrupt, command, RayRun)
    pid, deadline = int(mark.read_text()), time.monotonic() + PATIENCE
    while Path(f"/proc/{pid}").exists():
        assert time.monotonic() < deadline, "the run goes on"
        time.sleep(0.05)


@pytest.mark.parametrize(
    ("address", "said"),
    [("127.0.0.1:9", "expected a cluster at '127.0.0.1:9', got none"), ("there", "expected auto or host:port")],
)
def test_an_address_without_a_cluster_is_one_sentence(address: str, said: str):
    with pytest.raises(NoCluster, match=said):
        connect(address)


def test_without_ray_one_sentence_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(ray_cluster, "find_spec", lambda _: None)
    with pytest.raises(NoCluster, match=r"pip install 'surrogym\[ray\]'"):
        connect("auto")
