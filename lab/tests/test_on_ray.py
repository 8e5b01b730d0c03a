"""Studies in a real Ray cluster of this machine: what their cells wrote comes back, and none ends the others."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from support.studies import ignore, stand_in
from surrogym_client.runtime import ray_cluster
from surrogym_client.runtime.ray_cluster import NoCluster, connect
from surrogym_lab import cluster
from surrogym_lab.cluster import Task, TaskFailed, run_tasks
from surrogym_lab.peers import on_ray as peers_on_ray
from surrogym_lab.peers.points import TIME, Point
from surrogym_lab.peers.registry import METHODS, Method
from surrogym_lab.peers.study import PeerCell, run_cell
from surrogym_lab.reproduce import paper, paper_cases, paper_pictures
from surrogym_lab.reproduce.cells import Cell, cells, done_already, run_cells
from surrogym_lab.reproduce.on_ray import RayRun
from surrogym_lab.reproduce.rows import read_rows

ray = pytest.importorskip("ray")

PATIENCE = 60.0

pytestmark = [
    pytest.mark.long,  # a cluster takes long to start; test_cells.py and peers/test_processes.py run cells without one
    pytest.mark.timeout(600),
    pytest.mark.filterwarnings("ignore::FutureWarning:ray"),
]


def work_of(value: int) -> Callable[[Path], int]:
    """Work that notes in a file how many files came to its machine. It raises for -1."""

    def work(folder: Path) -> int:  # a function in a function travels by value, as the cluster can't import tests
        came = [path for path in folder.rglob("*") if path.is_file()]
        (folder / "done").mkdir(exist_ok=True)
        (folder / "done" / f"{value}").write_text(str(len(came)))
        return 10 // (value + 1)

    return work


def test_a_ray_task_gets_its_files_and_returns_those_it_wrote(address: str, tmp_path: Path):
    connect(address)
    (tmp_path / "other").write_text("stays here")
    results: dict[int, object] = {}

    def ended(value: int, task: Task[int]) -> None:
        try:
            results[value] = task.result()
        except TaskFailed as error:
            results[value] = str(error)

    run_tasks([4, -1, 1], lambda value: Task(work_of(value), tmp_path, "done"), 1, ended)
    assert results == {4: 2, -1: "ZeroDivisionError: integer division or modulo by zero", 1: 5}
    assert {path.name: path.read_text() for path in (tmp_path / "done").iterdir()} == {"4": "0", "-1": "1", "1": "2"}


def test_a_ray_machine_with_other_package_versions_is_refused_for_studies(
    address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    connect(address)
    monkeypatch.setattr(cluster, "versions", lambda: {"python": "2.7"})
    with pytest.raises(TaskFailed, match=r"expected python 2\.7 on every machine of the cluster, got 3\."):
        Task(work_of(1), tmp_path).result()


def test_a_run_of_the_paper_study_continues_on_ray_from_its_files(
    address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """The second run has the real steps of the first one. A cell that breaks leaves the others alone."""
    connect(address)
    monkeypatch.setattr(paper_pictures, "draw_all", lambda *_: [])  # which need all designs of a seed
    cell = paper_cases.Cell("cartpole", "printed", 0, paper_cases.QUICK)
    broken = replace(cell, seed=1)
    (tmp_path / "cells" / broken.name / "server.url").mkdir(parents=True)  # where its server writes a file
    words: list[str] = []
    rows, failed = paper.run_on_ray([broken, cell], tmp_path, 2, lambda _, said: words.append(said))
    assert [(row["task"], row["arm"], row["seed"]) for row in rows] == [("cartpole", "printed", 0)]
    assert [line.partition(":")[0] for line in failed] == ["cartpole printed seed 1"]
    assert words[-1].startswith("2 of 2")
    result = tmp_path / "cells" / cell.name / "design.json"
    first = result.read_bytes()
    result.unlink()
    assert paper.run_on_ray([cell], tmp_path, 1, lambda *_: None) == (rows, [])
    assert result.read_bytes() == first


def test_a_seed_of_the_paper_study_gives_the_same_table_on_ray_as_locally(address: str, tmp_path: Path):
    connect(address)
    todo = list(paper_cases.cells(["cartpole"], 1, paper_cases.QUICK))
    there, failed = paper.run_on_ray(todo, tmp_path / "there", 2, lambda *_: None)
    assert not failed
    here = paper.run_cells(todo, tmp_path / "here", lambda *_: None)
    assert paper.tables(there) == paper.tables(here)
    files = [{str(p.relative_to(tmp_path / w)) for p in (tmp_path / w).rglob("*")} for w in ("here", "there")]
    assert files[0] == files[1]


def test_study_runs_on_ray_leave_the_same_files_as_local_ones(address: str, tmp_path: Path):
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


def test_interrupting_a_study_ends_its_runs_on_ray(address: str, tmp_path: Path):
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


def test_comparison_runs_on_ray_leave_the_same_files_as_local_ones(
    address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """The method ``here`` is known to this process alone, so its cell breaks in the cluster."""
    connect(address)
    cells = [PeerCell("cartpole", "ppo", seed, episodes=1, minutes=-1.0) for seed in range(2)]
    monkeypatch.setitem(METHODS, "here", Method("here", METHODS["ppo"].make, budget=100))
    broken = PeerCell("cartpole", "here", 0)
    told: dict[PeerCell, Sequence[Point]] = {}
    peers_on_ray.run_cells([broken, *cells], tmp_path / "there", 2, told.__setitem__)
    assert told.keys() == {broken, *cells}
    for cell in cells:
        here = run_cell(cell, tmp_path / "here")
        assert [here[-1].ended] == [TIME]
        assert [replace(point, cpu_seconds=None) for point in cell.points(tmp_path / "there")] == [
            replace(point, cpu_seconds=None) for point in here
        ]
        assert cell.done(tmp_path / "there")
    [point] = broken.points(tmp_path / "there")
    assert point.ended == "KeyError: 'here'"
    assert not broken.done(tmp_path / "there")


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("127.0.0.1:9", "expected a Ray cluster at '127.0.0.1:9', got none"),
        ("there", "expected the address of a Ray cluster, auto or host:port"),
    ],
)
def test_a_ray_address_without_a_cluster_gives_a_one_sentence_error(address: str, said: str):
    with pytest.raises(NoCluster, match=said):
        connect(address)


def test_a_study_on_ray_without_ray_tells_how_to_install_it(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(ray_cluster, "find_spec", lambda _: None)
    with pytest.raises(NoCluster, match=r"pip install 'surrogym\[ray\]'"):
        connect("auto")
