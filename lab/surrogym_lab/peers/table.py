"""Table of the study: real steps of each method to our target."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from surrogym_lab.peers.curves import by_method, by_seed
from surrogym_lab.peers.points import TIME, Point
from surrogym_lab.peers.registry import task_of
from surrogym_lab.reproduce.markdown import markdown
from surrogym_lab.reproduce.statistics import bootstrap_interval
from surrogym_trainer.evaluation.evaluator import interquartile_mean

HEADING = (
    "task",
    "target",
    "method",
    "seeds",
    "reached",
    "real steps to the target",
    "real return",
    "episodes",
    "cpu min",
)
NOTES = """\
Real steps to the target: median (smallest to largest) of the seeds that reached it, and the real steps of those that
did not. Real return: interquartile mean over seeds after their last round, from three seeds on with a 95 % bootstrap
interval. Episodes: of each evaluation. CPU min: processor minutes of learning, median (largest).
"""


def table(points: Sequence[Point]) -> str:
    """A line for each task and method, as Markdown."""
    return markdown([HEADING, *(_line(task, method, of) for (task, method), of in by_method(points).items())])


def unfinished(asked: Sequence[tuple[str, str, int]], points: Sequence[Point]) -> list[str]:
    """Cells, by task, method and seed, that have no end among the points, as TASK METHOD (seeds N, M)."""
    done = {point.cell for point in points if point.ended}
    left: dict[str, list[str]] = {}
    for task, method, seed in asked:
        if (task, method, seed) not in done:
            left.setdefault(f"{task} {method}", []).append(str(seed))
    return [f"{name} (seeds {', '.join(seeds)})" for name, seeds in left.items()]


def _line(task: str, method: str, points: Sequence[Point]) -> Sequence[str]:
    last = [rounds[-1] for rounds in by_seed(points).values()]
    means = np.array([p.mean for p in last if p.mean is not None])
    episodes = sorted({p.episodes for p in last if p.episodes is not None})
    minutes = np.array([p.cpu_seconds for p in last if p.cpu_seconds is not None]) / 60
    return (
        *(task, task_of(task).target.words, method, str(len(last))),
        f"{sum(p.reached for p in last)} of {len(last)}",
        _steps(last),
        _returns(means),
        ", ".join(map(str, episodes)) or "-",
        f"{np.median(minutes):.1f} ({minutes.max():.1f})" if len(minutes) else "-",
    )


def _steps(last: Sequence[Point]) -> str:
    reached, other = [p for p in last if p.reached], [p for p in last if not p.reached]
    words = [_spread([p.real_steps for p in reached])] if reached else []
    if other:
        words.append(f"not reached by {_spread([p.real_steps for p in other])}")
    if any(p.ended == TIME for p in other):
        words.append("out of time")
    if running := sum(not p.ended for p in other):
        words.append(f"{running} not finished")
    if failed := [p.ended for p in other if ":" in p.ended]:
        words.append(f"{len(failed)} failed: {failed[0]}")
    return "; ".join(words)


def _spread(values: Sequence[int]) -> str:
    low, high = min(values), max(values)
    return f"{low:,}" if low == high else f"{np.median(values):,.10g} ({low:,} to {high:,})"


def _returns(means: np.ndarray) -> str:
    if not len(means):
        return "-"
    middle = f"{interquartile_mean(means):.1f}"
    if len(means) < 3:
        return middle
    low, high = bootstrap_interval(means)
    return f"{middle} ({low:.1f} to {high:.1f})"
