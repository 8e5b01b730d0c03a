"""Points of learning curves: the policy after one round of one cell, as a line of a CSV file."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from surrogym_lab.reproduce.rows import Row

REACHED, BUDGET, TIME = "reached", "budget", "time"


@dataclass(frozen=True)
class Point:
    """One round. Returns are over its evaluation.

    Attributes:
        round: from 1.
        real_steps: so far.
        mean, iqm, min, success: of the evaluation's episodes; None for a cell that failed before its first round.
        reached: whether the policy meets the whole target of the task.
        cpu_seconds: processor time of learning so far; None where it is not known.
        ended: why the cell ended with this round: reached, budget, time, or an error. Empty for the rounds before.
        specification: hash of what the cell was asked for, without the seed.
    """

    task: str
    method: str
    seed: int
    round: int
    real_steps: int
    mean: float | None = None
    iqm: float | None = None
    min: float | None = None
    success: float | None = None
    reached: bool = False
    episodes: int | None = None
    cpu_seconds: float | None = None
    ended: str = ""
    commit: str = ""
    specification: str = ""
    machine: str = ""

    @property
    def cell(self) -> tuple[str, str, int]:
        return self.task, self.method, self.seed


def points_of(rows: Iterable[Row]) -> list[Point]:
    """Points of runs of our arms. A run with several budgets has several points, the largest budget last."""
    found: list[Point] = []
    for row in sorted(rows, key=lambda row: (row.task, row.arm, row.seed, row.budget)):
        before = [point for point in found if point.cell == (row.task, row.arm, row.seed)]
        found.append(
            Point(
                task=row.task,
                method=row.arm,
                seed=row.seed,
                round=len(before) + 1,
                real_steps=row.budget if row.real_steps is None else row.real_steps,
                mean=row.mean,
                iqm=row.iqm,
                min=row.min,
                success=row.success,
                reached=row.reached,
                episodes=row.episodes,
                ended=row.error or (REACHED if row.reached else BUDGET),
                commit=row.commit,
                specification=row.specification,
                machine=row.machine,
            )
        )
    return found
