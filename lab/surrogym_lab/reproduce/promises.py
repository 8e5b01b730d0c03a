"""Tables of promises: how often trusted policies keep them, and how sharp they are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from surrogym_lab.reproduce.markdown import markdown
from surrogym_lab.reproduce.rows import Row
from surrogym_lab.reproduce.statistics import clustered_interval, exact_interval, interval_score
from surrogym_lab.tasks import EVERY_TASK

Array = NDArray[np.float64]

CHANCE = 0.9  # of a promise's interval
SHORT = 0.8  # share of the promised gain below which a policy falls short
HEADING = (
    *("task", "runs", "steps of audits", "reached their target", "trusted", "of those that reached it"),
    *("real return above the promise's 5 % quantile, of the trusted", "fall short, of the trusted"),
)
SCORES = ("task", "promises", "width", "interval score", "interval score with the mean width", "within")
NOTES = """\
Promises and audits of the default arm, with exact 95 % intervals of shares. A policy falls short if its gain over no
policy is below four fifths of the gain that it promised:
"""
SCORE_NOTES = """\
How sharp the promises are, trusted or not, as shares of the range between no policy and the best policy of the task.
Interval scores: lower is better (Gneiting and Raftery 2007). The mean width is that of all promises, around the same
medians:
"""


def promise_tables(groups: dict[tuple[str, str, int], list[Row]]) -> str:
    """The tables of the default arm's promises; empty if there are none."""
    promised = {
        task if budget == EVERY_TASK[task].budget else f"{task}, budget {budget}": found
        for (task, arm, budget), rows in groups.items()
        if arm == "default" and (found := [row for row in rows if row.promise is not None])
    }
    if not promised:
        return ""
    lines = [_line(name, rows) for name, rows in promised.items()]
    if len(promised) > 1:
        lines.append(_all(list(promised.values())))
    parts = [NOTES, markdown([HEADING, *lines])]
    if scores := _scores(promised):
        parts += [SCORE_NOTES, markdown([SCORES, *scores])]
    return "\n".join(parts)


def _kept(row: Row) -> bool:
    return row.mean is not None and row.promise_low is not None and row.mean >= row.promise_low


def _short(row: Row) -> bool:
    """Whether the gain over no policy is below ``SHORT`` of the promised one."""
    if row.mean is None or row.promise is None or row.without is None:
        return False
    return row.promise > row.without and row.mean - row.without < SHORT * (row.promise - row.without)


def _line(name: str, rows: Sequence[Row]) -> Sequence[str]:
    trusted, reached = [row for row in rows if row.trusted], [row for row in rows if row.reached]
    known = [row for row in trusted if row.without is not None]
    return (
        *(name, str(len(rows)), _range([row.audit_steps for row in rows])),
        *(str(len(reached)), str(len(trusted)), _of(sum(bool(row.trusted) for row in reached), len(reached))),
        *(_of(sum(map(_kept, trusted)), len(trusted)), _of(sum(map(_short, known)), len(known))),
    )


def _all(tasks: Sequence[Sequence[Row]]) -> Sequence[str]:
    """The line of all tasks. The share of kept promises has a second interval, whose tasks are resampled as wholes."""
    *line, kept, short = _line("all", [row for rows in tasks for row in rows])
    shares = [[float(_kept(row)) for row in rows if row.trusted] for rows in tasks]
    low, high = clustered_interval([np.array(of) for of in shares if of])
    return (*line, f"{kept}; by tasks {100 * low:.0f} to {100 * high:.0f} %", short)


def _scores(promised: dict[str, list[Row]]) -> list[Sequence[str]]:
    """Lines of ``SCORES`` for the tasks whose range is known."""
    scaled = {name: of for name, rows in promised.items() if len(of := _scaled(rows))}
    if not scaled:
        return []
    width = float(np.mean(np.concatenate([high - low for low, _, high, _ in (of.T for of in scaled.values())])))
    every = np.concatenate(list(scaled.values()))
    named = {**scaled, "all": every} if len(scaled) > 1 else scaled
    return [_score_line(name, of, width) for name, of in named.items()]


def _scaled(rows: Sequence[Row]) -> Array:
    """Low end, median, high end and real mean (n, 4) as shares of the range between no policy and the best one."""
    known = [
        (row.promise_low, row.promise, row.promise_high, row.mean, row.without)
        for row in rows
        if None not in (row.promise_low, row.promise, row.promise_high, row.mean, row.without)
    ]
    if not known:
        return np.empty((0, 4))
    values = np.array(known, dtype=np.float64)
    origin, best = values[:, 4].mean(), values[:, 3].max()
    return (values[:, :4] - origin) / (best - origin) if best > origin else np.empty((0, 4))


def _score_line(name: str, scaled: Array, width: float) -> Sequence[str]:
    low, median, high, real = scaled.T
    ours = interval_score(low, high, real, CHANCE).mean()
    fixed = interval_score(median - width / 2, median + width / 2, real, CHANCE).mean()
    within = int(((low <= real) & (real <= high)).sum())
    return (
        *(name, str(len(scaled)), f"{(high - low).mean():.3f}"),
        *(f"{ours:.3f}", f"{fixed:.3f}", _of(within, len(scaled))),
    )


def _of(count: int, of: int) -> str:
    if not of:
        return "-"
    low, high = exact_interval(count, of)
    return f"{count} of {of} ({100 * low:.0f} to {100 * high:.0f} %)"


def _range(values: Sequence[int | None]) -> str:
    known = sorted(value for value in values if value is not None)
    return "-" if not known else f"{known[0]} to {known[-1]}" if known[0] < known[-1] else str(known[0])
