"""The paper's numbers with ours: preset ``paper``, and the default with a tenth of the real steps."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

Row = dict[str, Any]
Number = Callable[[Row], float]

STEP_SECONDS = 0.05  # of Pendulum
UPRIGHT = 0.95  # cos of the angle
TRIALS = 100  # that the paper calls a run
BALANCED = 200

HEADING = ("what", "the paper", "preset paper", "Latin hypercube", "default")
ARMS = ("paper", "hypercube", "default")


def table(rows: Sequence[Row], task: str) -> list[tuple[str, ...]]:
    """Heading and lines of one task: median over seeds, with the smallest and the largest."""
    mine = [row for row in rows if row["task"] == task]
    lines: list[tuple[str, ...]] = [HEADING]
    for what, paper, number, shown in LINES[task]:
        lines.append((what, paper, *(_cell(mine, arm, number, shown) for arm in ARMS)))
    printed = [row for row in mine if row["arm"] == "printed"]
    lines.append(("real steps, index as printed", "", _spread(printed, _real_steps, "{:.0f}"), "", ""))
    used = [i for i in range(len(HEADING)) if any(line[i] for line in lines[1:])]
    return [tuple(line[i] for i in used) for line in lines]


def per_seed(rows: Sequence[Row]) -> Iterator[tuple[str, str, int, str, float]]:
    """Every number behind the tables: task, arm, seed, what, value."""
    for row in rows:
        numbers = (
            [("real steps", _real_steps)] if row["arm"] == "printed" else [(n[0], n[2]) for n in LINES[row["task"]]]
        )
        for what, number in numbers:
            yield row["task"], row["arm"], row["seed"], what, number(row)


def _cell(rows: Sequence[Row], arm: str, number: Number, shown: str) -> str:
    return _spread([row for row in rows if row["arm"] == arm], number, shown)


def _spread(rows: Sequence[Row], number: Number, shown: str) -> str:
    if not rows:
        return ""
    values = [value for row in rows if not math.isnan(value := number(row))]
    if not values:
        return "never"
    median, low, high = (shown.format(v) for v in (float(np.median(values)), min(values), max(values)))
    return median if low == high else f"{median} ({low} to {high})"


def _real_steps(row: Row) -> float:
    return float(row["design"]["initial"] + row["design"]["adaptive"])


def _index(which: str, place: int) -> Number:
    return lambda row: float(row["design"]["confidence"][place][which])


def _error(which: str, place: int) -> Number:
    return lambda row: float(row["design"]["errors"][place][which])


def _failed(variation: str) -> Number:
    return lambda row: 100 * (1 - float(np.mean(row["episodes"][variation]["success"])))


def _successes(variation: str) -> Number:
    return lambda row: float(np.sum(row["episodes"][variation]["success"]))


def _returned(variation: str, statistic: Callable[[Any], Any]) -> Number:
    return lambda row: float(statistic(row["episodes"][variation]["returns"]))


def _perfect_runs(variation: str) -> Number:
    """Share of runs of a hundred trials each, every one of which is balanced to the end."""

    def share(row: Row) -> float:
        lengths = np.array(row["episodes"][variation]["lengths"])
        runs = np.array_split(lengths, max(1, len(lengths) // TRIALS))
        return 100 * float(np.mean([bool((run == BALANCED).all()) for run in runs]))

    return share


def _whole_trials(variation: str) -> Number:
    return lambda row: 100 * float(np.mean(np.array(row["episodes"][variation]["lengths"]) == BALANCED))


def _settling(row: Row) -> float:
    """Seconds until the pole stays upright, mean over the traced runs that get there; NaN where none does."""
    times = [settling_time(trace["coordinates"]) for trace in row["episodes"]["five starts"]["traces"]]
    there = [time for time in times if time is not None]
    return float(np.mean(there)) if there else float("nan")


def settling_time(coordinates: Sequence[Sequence[float]]) -> float | None:
    """Seconds until the pole is upright for good, from coordinates (T + 1, 2); None if it never is."""
    upright = np.cos(np.array(coordinates)[:, 0]) > UPRIGHT
    if not upright[-1]:
        return None
    fallen = np.flatnonzero(~upright)
    return STEP_SECONDS * (0 if not len(fallen) else int(fallen[-1]) + 1)


Line = tuple[str, str, Number, str]

DESIGN: tuple[Line, ...] = (
    ("reward's index at first, relative", "", _index("reward", 0), "{:.2f}"),
    ("reward's index at last, relative", "", _index("reward", -1), "{:.3f}"),
    ("reward's error at first (rms)", "", _error("reward", 0), "{:.2f}"),
    ("reward's error at last (rms)", "", _error("reward", -1), "{:.2f}"),
    ("state's error at last, share of its deviation", "", _error("state", -1), "{:.3f}"),
)

LINES: dict[str, tuple[Line, ...]] = {
    "pendulum": (
        ("real steps", "40 + 85 = 125", _real_steps, "{:.0f}"),
        ("reward's index at first, as printed", "0.64", _index("reward_printed", 0), "{:.4f}"),
        ("reward's index at last, as printed", "0.999", _index("reward_printed", -1), "{:.4f}"),
        *DESIGN,
        ("of 100 starts anywhere, not upright at the end (%)", "under 15", _failed("any start"), "{:.0f}"),
        ("seconds until upright, five starts", "under 4", _settling, "{:.1f}"),
        ("limits 10 % higher, upright of 5", "4", _successes("higher limits"), "{:.0f}"),
        ("g, m, l off by 10 %, not upright (%)", "", _failed("other bodies"), "{:.0f}"),
        ("return, usual starts", "", _returned("usual starts", np.mean), "{:.0f}"),
        ("return, starts anywhere", "", _returned("any start", np.mean), "{:.0f}"),
        ("deviation of the return, starts anywhere", "", _returned("any start", np.std), "{:.0f}"),
    ),
    "cartpole": (
        ("real steps", "50 + 70 = 120", _real_steps, "{:.0f}"),
        ("reward's index at first, as printed", "0.72", _index("reward_printed", 0), "{:.4f}"),
        ("reward's index at last, as printed", "0.999", _index("reward_printed", -1), "{:.4f}"),
        *DESIGN,
        ("starts +-0.05, runs with 200 on average (%)", "100", _perfect_runs("starts +-0.05"), "{:.0f}"),
        ("starts +-0.05, trials of 200 (%)", "100", _whole_trials("starts +-0.05"), "{:.1f}"),
        ("starts +-0.1, runs with 200 on average (%)", "83", _perfect_runs("starts +-0.1"), "{:.0f}"),
        ("starts +-0.1, trials of 200 (%)", "", _whole_trials("starts +-0.1"), "{:.1f}"),
        ("masses off by 10 %, trials of 200 (%)", "100", _whole_trials("masses"), "{:.0f}"),
        ("masses off by 50 %, trials of 200 (%)", "", _whole_trials("masses, half"), "{:.0f}"),
    ),
}
