"""The paper's figures 5 to 15, drawn from the results of the cells. Single runs are those of the first seed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

Row = dict[str, Any]

BLUE, ORANGE, GREEN, GREY = "#4c72b0", "#dd8452", "#55a868", "#8c8c8c"
WIDTH, HEIGHT, DPI = 6.0, 3.6, 90
STEP_SECONDS = 0.05  # of Pendulum


def draw_all(rows: Sequence[Row], folder: Path) -> list[Path]:
    """Write ``figure05.png`` and so on; those of a task that was not run are left out."""
    drawn = []
    for task, figures in FIGURES.items():
        mine = [row for row in rows if row["task"] == task]
        for number, draw in figures.items() if mine else ():
            figure = Figure(figsize=(WIDTH, HEIGHT), layout="constrained")
            draw(figure, mine)
            drawn.append(folder / f"figure{number:02}.png")
            figure.savefig(drawn[-1], dpi=DPI)
    return drawn


def _of(rows: Sequence[Row], arm: str) -> list[Row]:
    return [row for row in rows if row["arm"] == arm]


def _confidence_and_error(figure: Figure, rows: Sequence[Row]) -> None:
    left, right = figure.subplots(1, 2)
    for row in _of(rows, "paper"):
        told, errors = row["design"]["confidence"], row["design"]["errors"]
        samples = [c["samples"] for c in told]
        left.plot(samples, [c["reward"] for c in told], color=BLUE, linewidth=0.8)
        left.plot(samples, [c["reward_printed"] for c in told], color=GREY, linewidth=0.8, linestyle="--")
        right.plot([e["samples"] for e in errors], [e["reward"] for e in errors], color=BLUE, linewidth=0.8)
    for row in _of(rows, "hypercube"):
        last = row["design"]["errors"][-1]
        right.plot(last["samples"], last["reward"], "x", color=ORANGE)
    left.set(xlabel="real steps", ylabel="confidence index of the reward", title="relative; dashed: as printed")
    right.set(xlabel="real steps", ylabel="error of the reward (rms)", title="x: Latin hypercube", ylim=(0, None))


def _samples(figure: Figure, rows: Sequence[Row]) -> None:
    axes = figure.add_subplot()
    samples = _of(rows, "paper")[0]["design"]["samples"]
    for purpose, colour in (("initial", BLUE), ("adaptive", ORANGE)):
        chosen = np.array([s["coordinates"] for s in samples if s["purpose"] == purpose])
        if len(chosen):
            axes.scatter(chosen[:, 0], chosen[:, 1], s=14, color=colour, label=f"{purpose} ({len(chosen)})")
    axes.set(xlabel="theta (rad)", ylabel="speed (rad/s)")
    figure.legend(loc="outside upper right")


def _response(which: str) -> Callable[[Figure, Sequence[Row]], None]:
    def draw(figure: Figure, rows: Sequence[Row]) -> None:
        axes, response = figure.add_subplot(), _of(rows, "paper")[0]["design"]["response"]
        model, order = response[which], np.argsort(response["real"])
        axes.plot(np.array(model["lower"])[order], ".", markersize=3, color=ORANGE, label="mean - 3 deviations")
        axes.plot(np.array(model["mean"])[order], ".", markersize=3, color=BLUE, label="mean")
        axes.plot(np.array(response["real"])[order], color="black", linewidth=1, label="original")
        title = f"after {model['samples']} real steps"
        axes.set(xlabel="unseen points, by their reward", ylabel="reward", title=title)
        axes.legend()

    return draw


def _losses(variation: str) -> Callable[[Figure, Sequence[Row]], None]:
    def draw(figure: Figure, rows: Sequence[Row]) -> None:
        axes = figure.add_subplot()
        for trace in _of(rows, "paper")[0]["episodes"][variation]["traces"]:
            loss = -np.array(trace["reward"])
            axes.plot(STEP_SECONDS * np.arange(len(loss)), loss, linewidth=0.9)
        axes.set(xlabel="time (s)", ylabel="loss", title=variation)

    return draw


def _hundred(figure: Figure, rows: Sequence[Row]) -> None:
    axes, result = figure.add_subplot(), _of(rows, "paper")[0]["episodes"]["any start"]
    starts, upright = np.array(result["starts"]), np.array(result["success"])
    loss = -np.array(result["returns"])
    points = axes.scatter(starts[:, 0], starts[:, 1], c=loss, s=18)
    x, y = starts[~upright].T
    axes.scatter(x, y, marker="x", s=60, color="red", label=f"not upright at the end ({len(x)})")
    figure.colorbar(points, ax=axes, label="summed loss")
    axes.set(xlabel="theta at the start (rad)", ylabel="speed at the start (rad/s)")
    axes.legend(loc="upper right")


def _ablation(figure: Figure, rows: Sequence[Row]) -> None:
    axes = figure.add_subplot()
    both = [[r for row in _of(rows, arm) for r in row["episodes"]["any start"]["returns"]] for arm in ABLATED]
    axes.boxplot(both, orientation="horizontal", tick_labels=list(ABLATED.values()), widths=0.6)
    axes.set(xlabel="real return, starts anywhere, all seeds")


def _transitions(figure: Figure, rows: Sequence[Row]) -> None:
    axes = figure.add_subplot()
    for (arm, label), colour in zip(ABLATED.items(), (BLUE, ORANGE), strict=True):
        path = np.array(_of(rows, arm)[0]["episodes"]["hanging"]["traces"][0]["coordinates"])
        axes.plot(np.unwrap(path[:, 0]), path[:, 1], linewidth=0.8, marker=".", markersize=2, color=colour, label=label)
    axes.set(xlabel="theta, unwrapped (rad)", ylabel="speed (rad/s)", title="from hanging")
    axes.legend()


def _balanced(names: Sequence[str]) -> Callable[[Figure, Sequence[Row]], None]:
    def draw(figure: Figure, rows: Sequence[Row]) -> None:
        for axes, name in zip(np.atleast_1d(figure.subplots(1, len(names), sharey=True)), names, strict=True):
            _lengths(axes, rows, name)

    return draw


def _lengths(axes: Axes, rows: Sequence[Row], variation: str) -> None:
    """Steps balanced in every episode, lowest first, one line a seed."""
    for arm, colour in (("default", GREEN), ("paper", BLUE)):
        for number, row in enumerate(_of(rows, arm)):
            lengths = np.sort(row["episodes"][variation]["lengths"])
            label = arm if number == 0 else None
            axes.plot(np.linspace(0, 100, len(lengths)), lengths, color=colour, linewidth=0.9, label=label)
    axes.set(xlabel="episodes (%)", ylabel="steps balanced of 200", title=variation, ylim=(0, 208))
    axes.legend()


ABLATED = {"paper": "adaptive", "hypercube": "hypercube"}

FIGURES: dict[str, dict[int, Callable[[Figure, Sequence[Row]], None]]] = {
    "pendulum": {
        5: _confidence_and_error,
        6: _samples,
        7: _response("low"),
        8: _response("high"),
        9: _losses("five starts"),
        10: _hundred,
        11: _losses("higher limits"),
        12: _ablation,
        13: _transitions,
    },
    "cartpole": {
        14: _balanced(("starts +-0.05", "starts +-0.1")),
        15: _balanced(("masses", "masses, half")),
    },
}
