"""Pictures of the study: learning curves of all methods on one task."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")

from matplotlib.figure import Figure

from surrogym_lab.peers.curves import by_method, curve
from surrogym_lab.peers.points import Point
from surrogym_lab.peers.registry import METHODS, OURS, task_of

PALETTE = (*(f"C{place}" for place in range(10)), "navy")
COLOURS = dict(zip((*OURS, *METHODS), PALETTE, strict=False))  # any further one is grey
SIZE = (7.0, 4.0)  # inches


def draw_tasks(folder: Path, points: Sequence[Point]) -> list[Path]:
    """Write ``peers-TASK.png`` for each task that has a curve."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for task in dict.fromkeys(point.task for point in points if point.mean is not None):
        written.append(folder / f"peers-{task.replace(':', '.')}.png")
        chosen = [point for point in points if point.task == task]
        draw_task(task, chosen).savefig(written[-1], dpi=120, metadata={"Software": None})
    return written


def draw_task(task: str, points: Sequence[Point]) -> Figure:
    """Draw the curve of each method with its interval, the return of every seed at its end, and the target."""
    figure = Figure(figsize=SIZE, layout="constrained")
    axes = figure.add_subplot()
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
    axes.set(xscale="log", xlabel="real steps", ylabel="real return of an episode", title=task)
    figure.legend(loc="outside right upper", frameon=False)
    return figure
