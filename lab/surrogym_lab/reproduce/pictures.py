"""Pictures of an efficiency study: real steps against real return, one picture a task."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, StrMethodFormatter

from surrogym_lab.arms import ARMS
from surrogym_lab.reproduce.rows import Row
from surrogym_lab.reproduce.statistics import bootstrap_interval
from surrogym_lab.reproduce.table import Group, column, grouped, tasks_with_results
from surrogym_trainer.evaluation.evaluator import interquartile_mean

OF_ARMS = (
    *("#dd8452", "#da8bc3", "#64b5cd", "#4c72b0", "#55a868", "#8172b3"),
    *("#ccb974", "#8c8c8c", "#937860", "#c9a66b", "#555555"),
)
COLOURS = dict(zip(ARMS, OF_ARMS, strict=True))
SIZE = (6.0, 3.6)  # inches
BESIDE = 0.05  # distance of the dots of single seeds from their arm, as a share of its real steps


def draw_tasks(folder: Path, rows: Sequence[Row]) -> list[Path]:
    """Write ``efficiency-TASK.png`` for each task that has a result."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for task in tasks_with_results(rows):
        groups = {group: of for group, of in grouped(rows).items() if group[0] == task and len(column(of, "mean"))}
        written.append(folder / f"efficiency-{task}.png")
        draw_task(task, groups).savefig(written[-1], dpi=120, metadata={"Software": None})
    return written


def draw_task(task: str, groups: dict[Group, list[Row]]) -> Figure:
    """Draw each arm at its median of real steps: interquartile mean with interval, and every seed next to it."""
    figure = Figure(figsize=SIZE, layout="constrained")
    axes = figure.add_subplot()
    named: set[str] = set()
    for (_, arm, _), rows in groups.items():
        known = [row for row in rows if row.mean is not None]
        means, steps = column(known, "mean"), column(known, "real_steps")
        middle, at = interquartile_mean(means), float(sorted(steps)[len(steps) // 2])
        low, high = bootstrap_interval(means)
        label = None if arm in named else arm
        named.add(arm)
        axes.errorbar(
            [at], [middle], [[middle - low], [high - middle]], color=COLOURS[arm], marker="o", capsize=4, label=label
        )
        axes.scatter((1 + BESIDE) * steps, means, s=9, color=COLOURS[arm], alpha=0.5, linewidths=0)
    axes.set(xscale="log", xlabel="real steps", ylabel="real return of an episode", title=task)
    axes.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]) if narrow(axes) else LogLocator(numticks=4))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    figure.legend(loc="outside right upper", frameon=False)
    return figure


def narrow(axes: Axes) -> bool:
    """Whether the steps span less than a power of ten, where a logarithmic axis has no round ticks."""
    low, high = axes.get_xlim()
    return high < 10 * low
