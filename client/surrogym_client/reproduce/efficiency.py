"""Evidence: the demo, over tasks, arms and seeds, as cells that can be resumed, and a table of what they gave.

A cell is one ``surrogym demo``; its metrics lie in a file of its own, and a cell whose file is there is not run again
unless what it depends on has changed. Every row carries a hash of that.
"""

from __future__ import annotations

import csv
import hashlib
import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_client.errors import SurrogymClientError
from surrogym_client.evaluate import interquartile_mean
from surrogym_client.versions import versions

ARMS: dict[str, tuple[str, ...]] = {"default": (), "paper": ("--preset", "paper")}
RESAMPLES = 2_000
COLUMNS = (
    *("task", "arm", "seed", "initial", "adaptive", "real_steps", "confidence_index", "phase", "virtual_steps"),
    *("mean", "iqm", "min", "mean_length", "success_rate", "seconds", "configuration"),
)


class CellFailed(SurrogymClientError):
    """A demo ended badly; its log says why."""


@dataclass(frozen=True)
class Cell:
    """One run: a task, an arm, a seed, and further options of the demo."""

    task: str
    arm: str
    seed: int
    options: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        return f"{self.task}-{self.arm}-seed{self.seed}"

    @property
    def arguments(self) -> tuple[str, ...]:
        return (self.task, "--seed", str(self.seed), *ARMS[self.arm], *self.options)

    @property
    def configuration(self) -> str:
        """A fingerprint of everything but the seed that the result depends on."""
        arm = [self.task, *ARMS[self.arm], *self.options, versions()]
        return hashlib.sha256(json.dumps(arm).encode()).hexdigest()[:12]


def cells(tasks: Sequence[str], arms: Sequence[str], seeds: int, options: Sequence[str] = ()) -> Iterator[Cell]:
    """Every combination, seeds 0 to ``seeds`` - 1 last."""
    for task, arm, seed in product(tasks, arms, range(seeds)):
        yield Cell(task, arm, seed, tuple(options))


def run_cell(cell: Cell, folder: Path) -> dict[str, Any]:
    """The row of a cell: read where it is there, else run.

    Raises:
        CellFailed: the demo ended badly.
    """
    done = folder / f"{cell.name}.json"
    if done.exists() and (row := _read(done))["configuration"] == cell.configuration:
        return row
    run, metrics = folder / cell.name, folder / f"{cell.name}.metrics.json"
    shutil.rmtree(run, ignore_errors=True)
    command = [
        sys.executable,
        "-m",
        "surrogym_client",
        "demo",
        *cell.arguments,
        "--out",
        str(run),
        "--json",
        str(metrics),
    ]
    with (folder / f"{cell.name}.log").open("wb") as log:
        ended = subprocess.run(command, stdout=log, stderr=log, check=False)
    if ended.returncode != 0:
        raise CellFailed(f"{cell.name} ended with exit code {ended.returncode}; its log: {log.name}")
    row = _row(cell, _read(metrics))
    done.write_text(json.dumps(row, indent=2) + "\n", encoding="utf-8")
    return row


def run_cells(todo: Sequence[Cell], folder: Path, report: Callable[[int, Cell], None]) -> list[dict[str, Any]]:
    """The rows of all cells, one after the other; ``report`` is told of each before it begins."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for number, cell in enumerate(todo):
        report(number, cell)
        rows.append(run_cell(cell, folder))
    with (folder / "results.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
    (folder / "results.md").write_text(markdown(summaries(rows)), encoding="utf-8")
    return rows


@dataclass(frozen=True)
class Summary:
    """One task under one arm. No seed is left out."""

    task: str
    arm: str
    seeds: int
    real_steps: str  # median (smallest to largest)
    real_return: str  # interquartile mean over seeds, 95 % bootstrap interval
    worst_seed: float  # mean return of the worst seed
    worst_episode: float
    success: str  # smallest share over seeds
    seconds: str  # median (largest)


def summaries(rows: Sequence[dict[str, Any]]) -> list[Summary]:
    """A summary of each task and arm, in the order of the rows."""
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["task"], row["arm"]), []).append(row)
    return [_summary(task, arm, group) for (task, arm), group in groups.items()]


def markdown(table: Sequence[Summary]) -> str:
    """The summaries as a table."""
    heading = [name.replace("_", " ") for name in Summary.__dataclass_fields__]
    rows = [[f"{v:.1f}" if isinstance(v, float) else str(v) for v in asdict(summary).values()] for summary in table]
    lines = [heading, ["---"] * len(heading), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def bootstrap_interval(values: NDArray[np.float64]) -> tuple[float, float]:
    """95 % percentile interval of the interquartile mean of values (n,), by resampling them."""
    rng = np.random.default_rng(0)
    drawn = rng.choice(values, (RESAMPLES, len(values)))
    low, high = np.percentile([interquartile_mean(sample) for sample in drawn], [2.5, 97.5])
    return float(low), float(high)


def _summary(task: str, arm: str, rows: Sequence[dict[str, Any]]) -> Summary:
    def column(name: str) -> NDArray[np.float64]:
        return np.array([row[name] for row in rows], dtype=np.float64)

    steps, means, seconds = column("real_steps"), column("mean"), column("seconds")
    low, high = bootstrap_interval(means)
    success = [row["success_rate"] for row in rows if row["success_rate"] is not None]
    return Summary(
        task=task,
        arm=arm,
        seeds=len(rows),
        real_steps=f"{np.median(steps):g} ({steps.min():g} to {steps.max():g})",
        real_return=f"{interquartile_mean(means):.1f} ({low:.1f} to {high:.1f})",
        worst_seed=float(means.min()),
        worst_episode=float(column("min").min()),
        success=f"{100 * min(success):.0f} %" if success else "-",
        seconds=f"{np.median(seconds):.0f} ({seconds.max():.0f})",
    )


def _row(cell: Cell, metrics: dict[str, Any]) -> dict[str, Any]:
    real, returns = metrics["real_queries"], metrics["real_return"]
    return {
        "task": cell.task,
        "arm": cell.arm,
        "seed": cell.seed,
        "initial": real["initial"],
        "adaptive": real["adaptive"],
        "real_steps": real["total"],
        "confidence_index": metrics["confidence_index"],
        "phase": metrics["phase"],
        "virtual_steps": metrics["virtual_steps"],
        "mean": returns["mean"],
        "iqm": returns["iqm"],
        "min": returns["min"],
        "mean_length": metrics["mean_length"],
        "success_rate": metrics["success_rate"],
        "seconds": metrics["seconds"]["total"],
        "configuration": cell.configuration,
    }


def _read(path: Path) -> dict[str, Any]:
    read: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return read
