"""Pictures of one run: the samples, the training, and the real episodes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire import SampleView, SurrogateView
from surrogym_shared.words import counted
from surrogym_trainer.evaluation.evaluator import Evaluation
from surrogym_trainer.figures import WIDTH, draw_samples, with_unit


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
    _save(folder / "rollout.png", draw_rollout(view.spec, result))


def draw_learning(curve: Sequence[dict[str, Any]]) -> Figure:
    """Draw the imagined return over the virtual steps of the training."""
    known = [(line["steps"], line["imagined_return"]) for line in curve if line["imagined_return"] is not None]
    figure, axes = _one("virtual steps", "imagined return of an episode", "training in the surrogate")
    axes.plot([steps for steps, _ in known], [value for _, value in known])
    return figure


def draw_returns(result: Evaluation) -> Figure:
    """Draw the distribution of the real returns."""
    figure, axes = _one("real return of an episode", "episodes", counted(len(result.returns), "real episode"))
    axes.hist(result.returns, bins=20)
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    return figure


def draw_rollout(spec: EnvironmentSpec, result: Evaluation) -> Figure:
    """Draw the coordinates and actions of the real episode with the median return over its steps."""
    at = result.ranked()["median"]
    trace = result.traces[at]
    actions = trace.action.shape[1]
    labels = [*map(with_unit, spec.coordinates), *(f"action {i}" if actions > 1 else "action" for i in range(actions))]
    lines = [*trace.coordinates.T, *trace.action.T]
    figure = Figure(figsize=(1.5 * WIDTH, 1.4 * len(lines)), layout="constrained")
    grid = figure.subplots(len(lines), 1, sharex=True, squeeze=False)[:, 0]
    for axes, label, line in zip(grid, labels, lines, strict=True):
        axes.plot(line, linewidth=0.6, marker=".", markersize=2)
        axes.set(ylabel=label)
    grid[-1].set(xlabel="step")
    figure.align_ylabels()
    figure.suptitle(f"the median of {counted(len(result.returns), 'real episode')}, return {result.returns[at]:.4g}")
    return figure


def _one(x: str, y: str, title: str) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(WIDTH, 0.6 * WIDTH), layout="constrained")
    axes = figure.add_subplot()
    axes.set(xlabel=x, ylabel=y, title=title)
    return figure, axes


def _save(path: Path, figure: Figure) -> None:
    figure.savefig(path, dpi=120)
