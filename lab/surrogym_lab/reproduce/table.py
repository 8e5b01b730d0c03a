"""Tables of an efficiency study, as Markdown. Every run counts, also a failed one."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from surrogym.demo.tasks import queries_a_round
from surrogym_lab.arms import ARMS
from surrogym_lab.reproduce.markdown import markdown
from surrogym_lab.reproduce.promises import promise_tables
from surrogym_lab.reproduce.rows import Row
from surrogym_lab.reproduce.statistics import bootstrap_interval, difference_interval
from surrogym_lab.tasks import EVERY_TASK
from surrogym_trainer.evaluation.evaluator import interquartile_mean

Group = tuple[str, str, int]
HEADING = (
    *("task", "arm", "seeds", "real steps", "real return", "worst seed", "worst episode"),
    *("success", "other starts", "imagined", "target reached", "virtual steps", "seconds"),
)
FEW = 3  # seeds; fewer give no useful interval
CONTRASTS = (  # what a pair of arms shows, at the same budget
    ("adaptive queries", "no_loop", "latin_hypercube"),
    ("adaptive queries, in the paper's representation", "paper", "paper_hypercube"),
    ("default's or paper's preset, on a hypercube", "latin_hypercube", "paper_hypercube"),
    ("acquisition", "no_loop", "variance"),
    ("symmetry", "default", "no_symmetry"),
    ("starts anywhere", "default", "declared_starts"),
    ("closed loop", "default", "no_loop"),
    ("adaptive queries and closed loop", "default", "latin_hypercube"),
    ("the whole of it", "default", "paper"),
    ("surrogate or original", "default", "oracle"),
)
WITHOUT_ROUNDS = {  # what the same pairs show if the design has the whole budget: whether an early stop matters
    "closed loop": ("an early stop", None),
    "adaptive queries and closed loop": ("adaptive queries and an early stop", "adaptive queries"),
}
NOTES = """\
Real steps: median (smallest to largest). Real return: interquartile mean over seeds of their means; from three seeds
on with a 95 % bootstrap interval. Worst seed: its mean. Success and other starts: share of the episodes, worst
seed. Imagined: what the surrogate promised. Target reached: by how many seeds of all; by the exact 95 % interval 10
of 10 fresh seeds would say that 69 % of all seeds do or more, 9 of 10 55 %, 5 of 5 48 %. Virtual steps, of the
training: median. Seconds: median (largest). A bootstrap of five seeds is narrower than its name.
"""


def report(rows: Sequence[Row]) -> str:
    """The headline, the main table, the questions that pairs of arms answer, and the origin of the rows."""
    parts = [headline(rows), summary(rows), NOTES]
    if pairs := contrasts(rows):
        parts += [
            "Difference of interquartile means, first arm minus second, with a 95 % bootstrap interval:\n",
            pairs,
        ]
    if promised := promise_tables(grouped(rows)):
        parts.append(promised)
    return "\n".join([*parts, _origin(rows)])


def headline(rows: Sequence[Row]) -> str:
    """A line for each task: what the default reached with the task's whole budget; empty where it was not run."""
    lines = [("task", "real steps", "target for each seed", "reached", "mean of the worst seed")]
    for (task, arm, budget), of in grouped(rows).items():
        if arm == "default" and budget == EVERY_TASK[task].budget:
            means, steps = column(of, "mean"), column(of, "real_steps")
            worst = _number(means.min()) if len(means) else "-"
            spent = _spread(steps) if len(steps) else "-"
            lines.append((task, spent, EVERY_TASK[task].target.words, _reached(of), worst))
    return markdown(lines) if len(lines) > 1 else ""


def summary(rows: Sequence[Row]) -> str:
    """The main table: a line for each task, arm and budget."""
    return markdown([HEADING, *(_line(group, of) for group, of in grouped(rows).items())])


def contrasts(rows: Sequence[Row]) -> str:
    """A line for each question that two arms with the same budget answer; empty where there is none."""
    groups = grouped(rows)
    lines = [("task", "question", "arms", "seeds", "difference", "interval", "better")]
    for task, budget in dict.fromkeys((task, budget) for task, _, budget in groups):
        for question, first, second in CONTRASTS:
            pair = [groups.get((task, arm, budget), []) for arm in (first, second)]
            means = [column(of, "mean") for of in pair]
            asked = _asked(question, budget, [*pair[0], *pair[1]])
            if asked is not None and min(map(len, means)) >= FEW:
                low, high = difference_interval(*means)
                lines.append(
                    (
                        task if budget == EVERY_TASK[task].budget else f"{task}, budget {budget}",
                        asked,
                        f"{first}, {second}",
                        f"{len(means[0])}, {len(means[1])}",
                        _number(interquartile_mean(means[0]) - interquartile_mean(means[1])),
                        f"{_number(low)} to {_number(high)}",
                        first if low > 0 else second if high < 0 else "undecided",
                    )
                )
    return markdown(lines) if len(lines) > 1 else ""


def grouped(rows: Sequence[Row]) -> dict[Group, list[Row]]:
    """Rows by task, arm and budget; tasks and arms in their order here, seeds ascending."""
    tasks, arms = list(EVERY_TASK), list(ARMS)

    def place(row: Row) -> tuple[int, int, int, int]:
        return tasks.index(row.task), row.budget, arms.index(row.arm), row.seed

    ordered = sorted((row for row in rows if row.task in EVERY_TASK and row.arm in ARMS), key=place)
    return {key: list(of) for key, of in groupby(ordered, key=lambda row: (row.task, row.arm, row.budget))}


def tasks_with_results(rows: Sequence[Row]) -> list[str]:
    """Tasks of which at least one run has a return, in their order."""
    return [task for task in EVERY_TASK if any(row.task == task and row.mean is not None for row in rows)]


def column(rows: Sequence[Row], name: str) -> NDArray[np.float64]:
    """The known values of a column."""
    return np.array([value for row in rows if (value := getattr(row, name)) is not None], dtype=np.float64)


def _line(group: Group, rows: Sequence[Row]) -> Sequence[str]:
    task, arm, budget = group
    name = arm if budget == EVERY_TASK[task].budget else f"{arm}, budget {budget}"
    crashed = sum(bool(row.error) for row in rows)
    seeds = f"{len(rows)}, {crashed} ended badly" if crashed else str(len(rows))
    means = column(rows, "mean")
    if not len(means):
        return task, name, seeds, *["-"] * (len(HEADING) - 3)
    imagined, virtual = column(rows, "imagined"), column(rows, "virtual_steps")
    return (
        task,
        name,
        seeds,
        _spread(column(rows, "real_steps")),
        _with_interval(means),
        _number(means.min()),
        _number(column(rows, "min").min()),
        _share(column(rows, "success")),
        _share(column(rows, "also_success")),
        _number(interquartile_mean(imagined)) if len(imagined) else "-",
        _reached(rows),
        f"{np.median(virtual):,.0f}" if len(virtual) and virtual.max() else "-",
        _median(column(rows, "seconds")),
    )


def _asked(question: str, budget: int, rows: Sequence[Row]) -> str | None:
    """What a pair shows if a budget leaves no rounds; None if both arms are then the same design."""
    if queries_a_round(budget) or question not in WITHOUT_ROUNDS:
        return question
    early, whole = WITHOUT_ROUNDS[question]
    return early if column(rows, "real_steps").min(initial=budget) < budget else whole


def _origin(rows: Sequence[Row]) -> str:
    """Commits and machines, with a warning if the compared rows differ in these."""
    lines = [f"Commits: {_listed(rows, 'commit')}. Machines: {_listed(rows, 'machine')}."]
    for (task, arm, budget), of in grouped(rows).items():
        for name, plural in (("configuration", "configurations"), ("commit", "commits")):
            made = {getattr(row, name) for row in of if getattr(row, name)}
            if len(made) > 1:
                lines.append(f"{task}, {arm}, budget {budget}: rows of {len(made)} {plural}.")
    return "\n".join(lines) + "\n"


def _listed(rows: Sequence[Row], name: str) -> str:
    return "; ".join(sorted({getattr(row, name) for row in rows if getattr(row, name)})) or "unknown"


def _reached(rows: Sequence[Row]) -> str:
    return f"{sum(row.reached for row in rows)} of {len(rows)}"


def _with_interval(means: NDArray[np.float64]) -> str:
    middle = _number(interquartile_mean(means))
    if len(means) < FEW:
        return middle
    low, high = bootstrap_interval(means)
    return f"{middle} ({_number(low)} to {_number(high)})"


def _spread(values: NDArray[np.float64]) -> str:
    low, high = values.min(), values.max()
    return f"{low:,.0f}" if low == high else f"{np.median(values):,.10g} ({low:,.0f} to {high:,.0f})"


def _median(values: NDArray[np.float64]) -> str:
    return f"{np.median(values):.0f} ({values.max():.0f})"


def _share(values: NDArray[np.float64]) -> str:
    return f"{100 * values.min():.0f} %" if len(values) else "-"


def _number(value: float) -> str:
    return f"{value:.1f}" if abs(value) >= 10 else f"{value:.3g}"
