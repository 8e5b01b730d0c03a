"""Demos of a study as tasks of a Ray cluster."""

from __future__ import annotations

import os
import subprocess
from functools import partial
from pathlib import Path

from surrogym_lab.cluster import Task, TaskFailed
from surrogym_lab.reproduce.cells import ONE_THREAD, Cell, Command, Places, Run, failed, row_of_run
from surrogym_lab.reproduce.rows import Row


class RayRun(Run):
    """A cell that runs in the cluster. Its log and its run folder come here when it is over."""

    def __init__(self, cell: Cell, folder: Path, command: Command) -> None:
        self.cell = cell
        self._places = Places.of(cell, folder)
        self._task = Task(partial(_exit_code, cell, command), folder)

    @property
    def over(self) -> bool:
        return self._task.over

    def row(self) -> Row:
        try:
            return row_of_run(self.cell, self._task.result(), self._places)
        except TaskFailed as error:
            return failed(self.cell, str(error))

    def end(self) -> None:
        self._task.end()

    def wait(self) -> None:
        """Return at once: Ray has ended the process."""


def _exit_code(cell: Cell, command: Command, folder: Path) -> int:
    """Run a cell, in a process of the cluster. The demo ends with this process."""
    places = Places.of(cell, folder)
    with places.log.open("wb") as log:
        return subprocess.run(
            command(cell, places.run),
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            env=os.environ | ONE_THREAD,
            check=False,
        ).returncode
