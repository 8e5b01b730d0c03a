"""Pictures of one run: where the samples fall, how training went, what the real episodes gave."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from surrogym_client.evaluate import Evaluation, Trace
from surrogym_shared.spec import Coordinate, EnvironmentSpec, limits
from surrogym_shared.wire import SampleView, SurrogateView

COLOURS = {"initial": "#4c72b0", "adaptive": "#dd8452", "manual": "#55a868"}
WIDTH = 6.0  # inches


def draw_all(
    folder: Path,
    view: SurrogateView,
    samples: Sequence[SampleView],
    curve: Sequence[dict[str, Any]],
    result: Evaluation,
) -> None:
    """Write ``samples.png``, ``learning.png``, ``returns.png`` and ``rollout.png`` into the folder."""
    _save(folder / "samples.png", draw_samples(view, samples))
    _save(folder / "learning.png", draw_learning(curve))
    _save(folder / "returns.png", draw_returns(result))
    _save(folder / "rollout.png", draw_rollout(view.spec, result.trace))


def draw_samples(view: SurrogateView, samples: Sequence[SampleView]) -> Figure:
    """Where the real steps began, two coordinates a picture."""
    coordinates = view.spec.coordinates
    pairs = [(i, min(i + 1, len(coordinates) - 1)) for i in range(0, len(coordinates), 2)]
    figure = Figure(figsize=(WIDTH, 0.8 * WIDTH * len(pairs)), layout="constrained")
    for n, (i, j) in enumerate(pairs):
        axes = figure.add_subplot(len(pairs), 1, n + 1)
        for purpose, colour in COLOURS.items():
            chosen = [s.coordinates for s in samples if s.purpose == purpose]
            if chosen:
                label = f"{purpose} ({len(chosen)})"
                axes.scatter([q[i] for q in chosen], [q[j] for q in chosen], color=colour, label=label, clip_on=False)
        axes.set(xlabel=_with_unit(coordinates[i]), ylabel=_with_unit(coordinates[j]))
        axes.set(xlim=limits(coordinates[i].sampling), ylim=limits(coordinates[j].sampling))
        if n == 0:
            figure.legend(loc="outside upper right")
    figure.suptitle(f"{view.name}: real steps of the design", x=0.02, ha="left")
    return figure


def draw_learning(curve: Sequence[dict[str, Any]]) -> Figure:
    """Imagined return over virtual steps."""
    known = [(line["steps"], line["imagined_return"]) for line in curve if line["imagined_return"] is not None]
    figure, axes = _one("virtual steps", "imagined return of an episode", "training in the surrogate")
    axes.plot([steps for steps, _ in known], [value for _, value in known])
    return figure


def draw_returns(result: Evaluation) -> Figure:
    """How the real returns spread."""
    figure, axes = _one("real return of an episode", "episodes", f"{len(result.returns)} real episodes")
    axes.hist(result.returns, bins=20)
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    return figure


def draw_rollout(spec: EnvironmentSpec, trace: Trace) -> Figure:
    """The first real episode: coordinates, and the action."""
    actions = trace.action.shape[1]
    labels = [*map(_with_unit, spec.coordinates), *(f"action {i}" if actions > 1 else "action" for i in range(actions))]
    lines = [*trace.coordinates.T, *trace.action.T]
    figure = Figure(figsize=(1.5 * WIDTH, 1.4 * len(lines)), layout="constrained")
    grid = figure.subplots(len(lines), 1, sharex=True, squeeze=False)[:, 0]
    for axes, label, line in zip(grid, labels, lines, strict=True):
        axes.plot(line, linewidth=0.6, marker=".", markersize=2)
        axes.set(ylabel=label)
    grid[-1].set(xlabel="step")
    figure.align_ylabels()
    figure.suptitle("the first real episode")
    return figure


def _with_unit(coordinate: Coordinate) -> str:
    return f"{coordinate.name} ({coordinate.unit})" if coordinate.unit else coordinate.name


def _one(x: str, y: str, title: str) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(WIDTH, 0.6 * WIDTH), layout="constrained")
    axes = figure.add_subplot()
    axes.set(xlabel=x, ylabel=y, title=title)
    return figure, axes


def _save(path: Path, figure: Figure) -> None:
    figure.savefig(path, dpi=120)
