"""Cells of the study as tasks of a Ray cluster."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from surrogym_lab.cluster import Task, TaskFailed, run_tasks
from surrogym_lab.peers.points import Point
from surrogym_lab.peers.study import PeerCell, run_cell
from surrogym_lab.reproduce.rows import write_records


def run_cells(todo: Sequence[PeerCell], folder: Path, jobs: int, tell: Callable[[PeerCell, list[Point]], None]) -> None:
    """Run cells, ``jobs`` at once, in the cluster that this process is connected to. The points of a cell come to the
    folder when it has ended. ``tell`` is called after each.

    A cell that gave nothing, because its process or machine died or its method broke, has a point with the reason. An
    interruption ends the cells that run, and their points are lost."""

    def ended(cell: PeerCell, task: Task[list[Point]]) -> None:
        try:
            points = task.result()
        except TaskFailed as error:
            reason = str(error)
            points = [Point(cell.task, cell.method, cell.seed, 0, 0, ended=reason, specification=cell.specification)]
            write_records(cell.file(folder), Point, points)
        tell(cell, points)

    run_tasks(todo, lambda cell: Task(partial(run_cell, cell), folder), jobs, ended)
