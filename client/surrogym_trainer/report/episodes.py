"""Figures of real episodes, and of predictions with measurements. Their lines differ in stroke, so that they can be
distinguished in black and white."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from surrogym_shared.spec import Coordinate, EnvironmentSpec
from surrogym_shared.wire import EpisodeTrace
from surrogym_trainer.report.figures import WIDTH, with_unit

Array = NDArray[np.float64]
Meet = Literal["start", "end"]
TURN = 2 * np.pi


class Stroke(NamedTuple):
    """The look of a line: colour, style and width."""

    colour: str
    style: str
    width: float


STROKES = (Stroke("black", "-", 1.6), Stroke("#2457c5", "--", 1.4), Stroke("#b3261e", ":", 2.0))


class Range(NamedTuple):
    """A mean return of one kind of episodes, with its interval."""

    label: str
    value: float
    low: float | None
    high: float | None


def draw_episodes(spec: EnvironmentSpec, shown: Sequence[tuple[str, EpisodeTrace]], meet: Meet = "end") -> Figure:
    """Draw coordinates and actions over the steps, one line for each of at most three episodes.

    Angles are drawn without jumps. At the step ``meet`` (the first or the last), the lines of an angle are shifted by
    full turns to be as near to each other as possible.
    """
    actions = len(shown[0][1].action[0]) if shown[0][1].action else 0
    labels = [
        *map(with_unit, spec.coordinates),
        *(f"action {i + 1}" if actions > 1 else "action" for i in range(actions)),
    ]
    figure = Figure(figsize=(1.5 * WIDTH, 1.5 * len(labels) + 0.6), layout="constrained")
    grid = figure.subplots(len(labels), 1, sharex=True, squeeze=False)[:, 0]
    first = shown[0][1].coordinates[_place(meet)]
    for (name, trace), stroke in zip(shown, STROKES, strict=False):
        states, given = np.array(trace.coordinates), np.array(trace.action).reshape(len(trace.action), -1)
        lines = [unbroken(c, states[:, i], meet, first[i]) for i, c in enumerate(spec.coordinates)]
        lines += [given[:, i] for i in range(actions)]
        for axes, line in zip(grid, lines, strict=True):
            axes.plot(line, color=stroke.colour, linestyle=stroke.style, linewidth=stroke.width, label=name)
    for axes, label in zip(grid, labels, strict=True):
        axes.set(ylabel=label)
        axes.grid(alpha=0.3)
    grid[-1].set(xlabel="step")
    figure.align_ylabels()
    handles, names = grid[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper left", ncols=3, frameon=False)
    return figure


def turns(spec: EnvironmentSpec) -> str:
    """Return a sentence about how angles are drawn; empty if there is no angle."""
    if all(coordinate.kind != "angle" for coordinate in spec.coordinates):
        return ""
    return "Angles are drawn without a jump after a full turn: values that are 6.28 rad apart are the same position."


def draw_ranges(ranges: Sequence[Range], label: str) -> Figure:
    """Draw numbers with their intervals one below the other, on one axis."""
    figure = Figure(figsize=(1.5 * WIDTH, 0.55 * len(ranges) + 0.9), layout="constrained")
    axes = figure.add_subplot()
    places = list(range(len(ranges)))[::-1]
    for place, one in zip(places, ranges, strict=True):
        if one.low is not None and one.high is not None:
            axes.plot([one.low, one.high], [place, place], color="black", linewidth=2, marker="|", markersize=12)
        axes.plot([one.value], [place], color="black", marker="o", markersize=8, linestyle="none")
        axes.annotate(f"{one.value:.4g}", (one.value, place), (0, 9), textcoords="offset points", ha="center")
    axes.set(yticks=places, yticklabels=[one.label for one in ranges], ylim=(-0.6, len(ranges) - 0.3), xlabel=label)
    axes.margins(x=0.12)
    axes.grid(axis="x", alpha=0.3)
    return figure


def unbroken(coordinate: Coordinate, values: Array, meet: Meet, to: float) -> Array:
    """Return the values (n,) of a coordinate for a picture. An angle is continued without jumps from pi to -pi, and
    shifted by full turns so that it is as near to ``to`` as possible at the step ``meet``."""
    if coordinate.kind != "angle":
        return values
    turned = np.unwrap(values)
    away = np.round((turned[_place(meet)] - to) / TURN)
    shown: Array = turned - TURN * away
    return shown


def _place(meet: Meet) -> int:
    """Return the index of the step at which drawn lines of an angle are to coincide: the first or the last."""
    return 0 if meet == "start" else -1
