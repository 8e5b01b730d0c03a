"""Figures of a surrogate: the certainty of each model, the uncertainty of the latest one, and the starts of
real steps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from io import StringIO

import matplotlib
import numpy as np

matplotlib.use("Agg")

from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from surrogym_shared.spec import Coordinate, limits
from surrogym_shared.wire import ModelView, OutputFidelity, SampleView, SurrogateView
from surrogym_trainer.coverage import Coverage, Cut, columns_shown, pairs

COLOURS = {"logged": "#8c8c8c", "initial": "#4c72b0", "adaptive": "#dd8452", "manual": "#55a868", "audit": "#c44e52"}
WIDTH = 6.0  # width of a figure in inches
SMALLEST = 1e-9  # smaller errors are drawn as this value on a logarithmic axis
DECADES = 6  # a map of the paper's uncertainty index shows this number of powers of ten below its maximum
LOG_10 = math.log(10)


def draw_fidelity(models: Sequence[ModelView], target: float) -> Figure:
    """Draw the confidence index of every output, and its leave-one-out error as a multiple of its tolerance, against
    the number of real samples."""
    figure = Figure(figsize=(WIDTH, WIDTH), layout="constrained")
    sure, wrong = figure.subplots(2, 1, sharex=True)
    names = [output.name for output in models[-1].fidelity.outputs] if models else []
    for name in names:
        said = [(model.samples, o) for model in models for o in model.fidelity.outputs if o.name == name]
        samples = [count for count, _ in said]
        sure.plot(samples, [o.confidence_index for _, o in said], marker="o", label=name)
        wrong.plot(samples, [_in_tolerances(o) for _, o in said], marker="o")
    sure.axhline(target, color="black", linestyle="--", linewidth=0.8, label=f"target {target:g}")
    wrong.axhline(1.0, color="black", linestyle="--", linewidth=0.8)
    sure.set(ylabel="confidence index")
    wrong.set(ylabel="leave-one-out error / tolerance", xlabel="real samples", yscale="log")
    wrong.xaxis.set_major_locator(MaxNLocator(integer=True))
    figure.legend(loc="outside upper right", ncols=4)
    return figure


def _in_tolerances(output: OutputFidelity) -> float:
    """Return the leave-one-out error of an output as a multiple of its tolerance. It is NaN, which is not drawn, if the
    family of models can't compute it."""
    error = output.leave_one_out_error
    return math.nan if error is None else max(error / output.tolerance, SMALLEST)


def draw_samples(view: SurrogateView, samples: Sequence[SampleView]) -> Figure:
    """Draw the states in which the real steps began, two coordinates in each picture."""
    coordinates, shown = view.spec.coordinates, pairs(view.spec)
    figure = Figure(figsize=(WIDTH, 0.8 * WIDTH * len(shown)), layout="constrained")
    for n, (i, j) in enumerate(shown):
        axes = figure.add_subplot(len(shown), 1, n + 1)
        for purpose, colour in COLOURS.items():
            chosen = [s.coordinates for s in samples if s.purpose == purpose]
            if chosen:
                label = f"{purpose} ({len(chosen)})"
                axes.scatter([q[i] for q in chosen], [q[j] for q in chosen], color=colour, label=label, clip_on=False)
        axes.set(xlabel=with_unit(coordinates[i]), ylabel=with_unit(coordinates[j]))
        axes.set(xlim=limits(coordinates[i].sampling), ylim=limits(coordinates[j].sampling))
        if n == 0 and samples:
            figure.legend(loc="outside upper right")
    figure.suptitle(f"{view.name}: real steps of the design", x=0.02, ha="left")
    return figure


def draw_coverage(coverage: Coverage) -> Figure:
    """Draw how often a log visited each cell of two columns; cells without steps are white."""
    shown = columns_shown(coverage.names)
    figure = Figure(figsize=(WIDTH, WIDTH), layout="constrained")
    grid = figure.subplots(len(shown) - 1, len(shown) - 1, squeeze=False)
    most = max(int(counts.max()) for counts in coverage.counts.values())
    for row, j in enumerate(shown[1:]):
        for column, i in enumerate(shown[:-1]):
            axes = grid[row, column]
            if column > row:
                axes.axis("off")
                continue
            counts = coverage.counts[i, j].T
            axes.imshow(
                np.ma.masked_equal(counts, 0),
                origin="lower",
                extent=(*coverage.ends[i], *coverage.ends[j]),
                aspect="auto",
                cmap="Blues",
                norm=LogNorm(0.3, max(most, 1)),
            )
            axes.tick_params(labelsize=6)
            axes.set_title(f"{100 * coverage.share((i, j)):.0f} %", fontsize=7, pad=2)
            axes.set(
                xlabel=coverage.names[i] if row == len(shown) - 2 else "",
                ylabel=coverage.names[j] if column == 0 else "",
            )
    left_out = len(coverage.names) - len(shown)
    figure.suptitle("where the log has been" + (f"; {left_out} columns are not shown" if left_out else ""), fontsize=9)
    return figure


def draw_maps(view: SurrogateView, cuts: Sequence[Cut]) -> Figure:
    """Draw three maps for each pair of coordinates in ``cuts``: the model's uncertainty, how often policies visit a
    state (occupancy), and the paper's uncertainty index, which combines both."""
    figure = Figure(figsize=(1.5 * WIDTH, 0.45 * WIDTH * len(cuts)), layout="constrained")
    rows = figure.subplots(len(cuts), 3, squeeze=False)
    for row, cut in zip(rows, cuts, strict=True):
        x, y = (view.spec.coordinates[which] for which in (cut.across, cut.up))
        highest = cut.log_index.max() / LOG_10
        panels = (
            ("uncertainty / tolerance", cut.uncertainty, {"norm": LogNorm(0.1, 10, clip=True), "cmap": "Oranges"}),
            ("occupancy", cut.occupancy, {"vmin": 0.0, "cmap": "Blues"}),
            ("log10 of the index", cut.log_index / LOG_10, {"vmin": highest - DECADES, "cmap": "Purples"}),
        )
        for axes, (title, values, how) in zip(row, panels, strict=True):
            extent = (*limits(x.sampling), *limits(y.sampling))
            image = axes.imshow(values, origin="lower", extent=extent, aspect="auto", **how)
            figure.colorbar(image, ax=axes, label=title)
            axes.set(xlabel=with_unit(x), ylabel=with_unit(y))
    return figure


def with_unit(coordinate: Coordinate) -> str:
    """Return the label of a coordinate's axis: its name, with the unit if it has one."""
    return f"{coordinate.name} ({coordinate.unit})" if coordinate.unit else coordinate.name


def svg(figure: Figure) -> str:
    """Return a figure as the text of an SVG element; equal figures give equal texts."""
    text = StringIO()
    with matplotlib.rc_context({"svg.hashsalt": "surrogym", "svg.fonttype": "path"}):
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    whole = text.getvalue()
    return whole[whole.index("<svg") :]
