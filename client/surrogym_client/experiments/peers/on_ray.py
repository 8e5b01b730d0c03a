"""Cells of the study as tasks of a Ray cluster. Each takes one CPU, on whatever machine has one free."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from surrogym_client.experiments.peers.points import Point
from surrogym_client.experiments.peers.study import PeerCell, run_cell
from surrogym_client.experiments.reproduce.rows import write_records

RETRIES = 1  # of a cell whose process or machine died
LOOK_SECONDS = 1.0  # between two chances of an interruption


def run_cells(todo: Sequence[PeerCell], folder: Path, jobs: int, tell: Callable[[PeerCell, list[Point]], None]) -> None:
    """Run cells, ``jobs`` at once, in the cluster that this process is connected to. The points of a cell come to the
    folder when it has ended. ``tell`` is called after each.

    A cell that gave nothing, because its process or machine died or its method broke, has a point with the reason. An
    interruption ends the cells that run, and their points are lost."""
    import ray

    remote: Any = ray.remote(num_cpus=1, max_retries=RETRIES, max_calls=1)(_points)
    waiting, running = list(todo), dict[Any, PeerCell]()
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                running[remote.remote(waiting[0])] = waiting[0]
                del waiting[0]
            ended, _ = ray.wait(list(running), timeout=LOOK_SECONDS)
            for asked in ended:
                cell = running.pop(asked)
                points = _result(cell, asked)
                write_records(cell.file(folder), Point, points)
                tell(cell, points)
    finally:
        for asked in running:
            with suppress(ray.exceptions.RayError, ValueError):
                ray.cancel(asked, force=True)


def _result(cell: PeerCell, asked: Any) -> list[Point]:
    import ray

    try:
        points: list[Point] = ray.get(asked)
    except ray.exceptions.RayError as error:
        last = (str(error).strip().splitlines() or [type(error).__name__])[-1]
        raised = isinstance(error, ray.exceptions.RayTaskError)
        reason = last if raised else f"the process or machine of the run died: {last}"
        return [Point(cell.task, cell.method, cell.seed, 0, 0, ended=reason[:300], specification=cell.specification)]
    return points


def _points(cell: PeerCell) -> list[Point]:
    """Run a cell in a process of the cluster."""
    with tempfile.TemporaryDirectory(prefix="surrogym-") as folder:
        return run_cell(cell, Path(folder))
