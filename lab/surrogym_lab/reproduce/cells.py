"""Cells: one demo each, in separate processes, several at once. A cell that has a row already is not run again."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from surrogym.demo.settings import fingerprint
from surrogym_client.runtime.versions import commit, machine
from surrogym_lab.arms import ARMS
from surrogym_lab.reproduce.rows import Key, Row, merge, row_of, write_rows
from surrogym_lab.settings import StudySettings
from surrogym_lab.tasks import EVERY_TASK

COMPARED = ("pendulum", "cartpole", "mountaincar", "swingup")  # tasks on which a study runs every arm
EVERY_SEED = ("latin_hypercube", "paper")  # arms that it runs with as many seeds as the default
LOOK_SECONDS = 0.2
ENDING_SECONDS = 30.0  # a demo ends its own processes first
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")


@dataclass(frozen=True)
class Cell:
    """One run of the demo."""

    settings: StudySettings

    @property
    def name(self) -> str:
        s = self.settings
        budget = "" if s.budget is None else f"-budget{s.budget}"
        return f"{s.task}-{s.arm}{budget}-seed{s.seed}"

    @property
    def arguments(self) -> tuple[str, ...]:
        """The arguments of ``python -m surrogym_lab demo``."""
        s = self.settings
        given = {"--seed": s.seed, "--arm": s.arm, "--budget": s.budget, "--steps": s.steps, "--episodes": s.episodes}
        given |= {"--algorithm": s.algorithm}
        options = [word for name, value in given.items() if value is not None for word in (name, str(value))]
        return (s.task, *options, *(() if s.pictures else ("--no-pictures",)))

    @property
    def key(self) -> Key:
        """The key of its row."""
        s = self.settings
        return s.task, s.arm, s.real_steps, s.seed

    @property
    def specification(self) -> str:
        """Hash of the settings, without the seed."""
        return _specification(replace(self.settings, seed=0))


Command = Callable[[Cell, Path], list[str]]
Begin = Callable[[Cell, Path, Command], "Run"]


@dataclass(frozen=True)
class Progress:
    """Progress while cells run. ``left_seconds`` is an estimate, None before the first cell has ended."""

    done: int
    of: int
    running: tuple[str, ...]
    left_seconds: float | None
    last: Row | None = None  # the cell that has just ended


def cells(
    tasks: Sequence[str],
    arms: Sequence[str],
    seeds: Iterable[int],
    *,
    shares: Sequence[float] = (1.0,),
    steps: int | None = None,
    episodes: int = 100,
    algorithm: str | None = None,
) -> Iterator[Cell]:
    """Every combination of tasks, arms and shares with one seed, then with the next.

    Args:
        tasks, arms, seeds: values to combine.
        shares: of each task's budget of real steps.
        steps: virtual steps; None takes the task's.
        episodes: of each evaluation.
        algorithm: name of a policy search; None takes the command's.
    """
    for seed, task, arm, share in product(seeds, tasks, arms, shares):
        budget = None if share == 1 else max(2, round(share * EVERY_TASK[task].budget))
        settings = StudySettings(task, seed, budget, steps, episodes, pictures=False, algorithm=algorithm, arm=arm)
        yield Cell(settings)


def study(tasks: Sequence[str], seeds: Sequence[int], **chosen: Any) -> Iterator[Cell]:
    """The efficiency study of the documentation: the default on every task, a hypercube and the paper's preset on the
    tasks of ``COMPARED``, and there the other arms with the first half of the seeds. ``chosen`` as for ``cells``."""
    compared = [task for task in tasks if task in COMPARED]
    others = [name for name, arm in ARMS.items() if name not in ("default", *EVERY_SEED) and not arm.access]
    for place, seed in enumerate(seeds):
        yield from cells(tasks, ["default"], [seed], **chosen)
        yield from cells(compared, [*EVERY_SEED, *(others if 2 * place < len(seeds) else ())], [seed], **chosen)


def done_already(cell: Cell, rows: Iterable[Row]) -> bool:
    """Whether a row is the result of a cell with the same settings, and the run did not fail."""
    return any(row.key == cell.key and row.specification == cell.specification and not row.error for row in rows)


def demo_command(cell: Cell, run: Path) -> list[str]:
    """The command line that runs a cell into a run folder."""
    demo = [sys.executable, "-m", "surrogym_lab", "demo"]
    return [*demo, *cell.arguments, "--out", str(run), "--exit-with-parent"]


def run_cells(
    todo: Sequence[Cell],
    rows: Sequence[Row],
    folder: Path,
    jobs: int,
    tell: Callable[[Progress], None],
    command: Command = demo_command,
    begin: Begin | None = None,
) -> list[Row]:
    """Run cells, several at once. ``rows.csv`` in the folder is written after each.

    Args:
        todo: cells to run.
        rows: existing rows.
        folder: of rows, logs and run folders.
        jobs: cells at once.
        tell: called at every poll.
        command: runs a cell into a run folder, where it leaves ``metrics.json``.
        begin: begins a run; None begins a process of this machine.

    Returns:
        All rows, old and new. A failed run has a row too, with its error.
    """
    folder.mkdir(parents=True, exist_ok=True)
    known, waiting, running = list(rows), list(todo), list[Run]()
    new: list[Row] = []
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                running.append((begin or ProcessRun)(waiting.pop(0), folder, command))
            for job in [job for job in running if job.over]:
                running.remove(job)
                new.append(job.row())
                known = merge(known, new[-1:])
                write_rows(folder / "rows.csv", known)
                tell(_progress(new, todo, running, jobs, new[-1]))
            tell(_progress(new, todo, running, jobs))
            time.sleep(LOOK_SECONDS)
    finally:
        for job in running:
            job.end()
        for job in running:
            job.wait()
    return known


@dataclass(frozen=True)
class Places:
    """Where a cell leaves its run folder and its log."""

    run: Path
    log: Path

    @classmethod
    def of(cls, cell: Cell, folder: Path) -> Places:
        """The places of a cell in the folder of a study, without what an earlier run left there."""
        places = cls(folder / "runs" / cell.name, folder / "logs" / f"{cell.name}.log")
        shutil.rmtree(places.run, ignore_errors=True)
        places.log.parent.mkdir(parents=True, exist_ok=True)
        return places


class Run(ABC):
    """A cell that runs."""

    cell: Cell

    @property
    @abstractmethod
    def over(self) -> bool:
        """Whether it has ended, well or not."""

    @abstractmethod
    def row(self) -> Row:
        """Return what the run gave, once it is over."""

    @abstractmethod
    def end(self) -> None:
        """Ask it to end."""

    @abstractmethod
    def wait(self) -> None:
        """Wait for its end for a while, and make sure of it."""


class ProcessRun(Run):
    """A cell that runs in a process of this machine."""

    def __init__(self, cell: Cell, folder: Path, command: Command) -> None:
        self.cell = cell
        self._places = Places.of(cell, folder)
        with self._places.log.open("wb") as log:
            self._process = subprocess.Popen(
                command(cell, self._places.run),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env=os.environ | ONE_THREAD,
                start_new_session=True,  # Ctrl-C reaches it through end() alone
            )

    @property
    def over(self) -> bool:
        return self._process.poll() is not None

    def row(self) -> Row:
        return row_of_run(self.cell, self._process.returncode, self._places)

    def end(self) -> None:
        """Ask it to stop. It stops its own processes."""
        self._process.terminate()

    def wait(self) -> None:
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(ENDING_SECONDS)
        self._process.kill()
        self._process.wait()


def row_of_run(cell: Cell, code: int, places: Places) -> Row:
    """Return the row of a run that ended with an exit code."""
    if code == 0:
        return row_of(json.loads((places.run / "metrics.json").read_text(encoding="utf-8")))
    said = places.log.read_text(encoding="utf-8", errors="replace").strip().splitlines() or ["no output"]
    return failed(cell, f"exit code {code}: {said[-1][:300]}")


def failed(cell: Cell, error: str) -> Row:
    """Return the row of a run that gave nothing."""
    task, arm, budget, seed = cell.key
    return Row(
        *(task, arm, seed, budget),
        commit=commit(),
        specification=cell.specification,
        machine=machine(),
        error=error,
    )


def _progress(
    new: Sequence[Row], todo: Sequence[Cell], running: Sequence[Run], jobs: int, last: Row | None = None
) -> Progress:
    names = tuple(job.cell.name for job in running)
    seconds = {(row.task, row.arm): row.seconds for row in new if row.seconds is not None}
    if not seconds:
        return Progress(len(new), len(todo), names, None, last)
    usual = float(np.mean(list(seconds.values())))
    finished = {row.key for row in new}
    left = [cell for cell in todo if cell.key not in finished]
    guess = sum(seconds.get(cell.key[:2], usual) for cell in left) / jobs
    return Progress(len(new), len(todo), names, guess, last)


@cache
def _specification(settings: StudySettings) -> str:
    return fingerprint(settings.asked())
