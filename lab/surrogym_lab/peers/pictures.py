"""One figure of the study: learning curves of all methods, a panel for each task.

Usage: python -m surrogym_lab.peers.pictures lab/records/results/peers.csv lab/records/results
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, StrMethodFormatter

from surrogym_lab.peers.curves import by_method, curve
from surrogym_lab.peers.points import Point
from surrogym_lab.peers.registry import METHODS, OURS, task_of
from surrogym_lab.reproduce.rows import read_records

PALETTE = (*(f"C{place}" for place in range(10)), "navy")
COLOURS = dict(zip((*OURS, *METHODS), PALETTE, strict=False))  # any further one is grey
PANEL = (4.0, 2.9)  # inches


def draw_tasks(folder: Path, points: Sequence[Point]) -> list[Path]:
    """Write ``peers.png``, with a panel for each task that has a curve, two beside each other."""
    tasks = list(dict.fromkeys(point.task for point in points if point.mean is not None))
    if not tasks:
        return []
    folder.mkdir(parents=True, exist_ok=True)
    columns = min(2, len(tasks))
    rows = -(-len(tasks) // columns)
    figure = Figure(figsize=(columns * PANEL[0] + 1.3, rows * PANEL[1]), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for panel, task in zip(panels, tasks, strict=False):
        draw_task(panel, task, [point for point in points if point.task == task])
    for panel in panels[len(tasks) :]:
        panel.remove()
    named = {
        text: handle for axes in figure.axes for handle, text in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    figure.legend(named.values(), named.keys(), loc="outside right upper", frameon=False)
    path = folder / "peers.png"
    figure.savefig(path, dpi=150, metadata={"Software": None})
    return [path]


def draw_task(axes: Axes, task: str, points: Sequence[Point]) -> None:
    """Draw the curve of each method with its interval, the return of every seed at its end, and the target."""
    for (_, method), of in by_method(points).items():
        if (found := curve(of)) is None:
            continue
        colour = COLOURS.get(method, "grey")
        marker = "o" if len(found.steps) < 3 else None
        axes.plot(found.steps, found.middle, color=colour, label=method, marker=marker, drawstyle="steps-post")
        if found.low is not None and found.high is not None:
            axes.fill_between(found.steps, found.low, found.high, color=colour, alpha=0.2, linewidth=0, step="post")
        ends = np.array([(p.real_steps, p.mean) for p in of if p.ended and p.mean is not None]).reshape(-1, 2)
        axes.scatter(ends[:, 0], ends[:, 1], s=12, color=colour, alpha=0.6, linewidths=0)
    target = task_of(task).target
    if (line := target.lowest if target.mean is None else target.mean) is not None:
        axes.axhline(line, color="black", linestyle=":", linewidth=1, label="target")
    axes.set(xscale="log", xlabel="real steps", ylabel="real return")
    axes.set_title(f"{task}: {target.words}" if target.words else task, fontsize=9)
    axes.xaxis.set_major_locator(LogLocator(numticks=6))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axes.yaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))


if __name__ == "__main__":
    draw_tasks(Path(sys.argv[2]), read_records(Path(sys.argv[1]), Point))
