"""True one-step error against real queries: adaptive criteria beside a Latin hypercube, in three representations.

Run by ``make acquisition``. A cell is one task, representation, criterion and seed; its rows go into rows.csv at once,
and a cell whose rows are there is not run again, so the same command goes on after Ctrl-C. No policy is trained: what
is measured is the model, on fresh real points that no design sees and that neither start nor end past a termination.

The error is the root mean square over points and outputs (observation entries and reward), each output in units of the
deviation of its own change, so that the representations can be compared with each other.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from itertools import product
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import matplotlib
import numpy as np
import torch

matplotlib.use("Agg")

from matplotlib.figure import Figure

from support.models import learn
from support.real_steps import answer, arrays, join, random_steps
from surrogym_client.runtime.versions import commit
from surrogym_lab.reproduce.statistics import bootstrap_interval, difference_interval
from surrogym_sampler.original import make
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.samples import Samples
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.sampling.design import advance, initial_queries
from surrogym_server.sampling.state import DesignState, Request
from surrogym_shared.spec import Design, EnvironmentSpec
from surrogym_trainer.evaluation.evaluator import interquartile_mean

TASKS = {"pendulum": "Pendulum-v1", "acrobot": "Acrobot-v1", "mountaincar": "MountainCarContinuous-v0"}
DESIGNS = {  # by representation
    "symmetry": {"preset": "default"},
    "coordinates": {"preset": "default", "symmetry": "none"},
    "observation": {"preset": "paper"},
}
CRITERIA = ("integrated_variance", "variance", "uncertainty_index", "latin_hypercube")
QUERIES = {  # real queries at which the error is measured; the first are the initial design
    ("pendulum", "symmetry"): (4, 6, 8, 10, 14),
    ("pendulum", "coordinates"): (6, 8, 10, 14),
    ("pendulum", "observation"): (20, 30, 40, 60),
    ("mountaincar", "symmetry"): (4, 6, 8, 10, 14),  # its valley is no mirror image; the same as coordinates
    ("mountaincar", "observation"): (10, 15, 20, 30),
    ("acrobot", "symmetry"): (40, 60, 80, 100),
    ("acrobot", "coordinates"): (40, 60, 80, 100),
    ("acrobot", "observation"): (40, 60, 80, 100),
}
TEST_POINTS, TEST_SEED = 1_000, 20_000


@dataclass(frozen=True)
class Row:
    task: str
    representation: str
    criterion: str
    seed: int
    queries: int
    error: float
    commit: str


def main() -> None:
    options = _options()
    out: Path = options.out
    out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    rows = read(out / "rows.csv")
    done = {(row.task, row.representation, row.criterion, row.seed) for row in rows}
    for seed, task, representation, criterion in product(
        range(options.seeds), options.tasks, options.representations, options.criteria
    ):
        if (task, representation) in QUERIES and (task, representation, criterion, seed) not in done:
            rows += list(cell(task, representation, criterion, seed))
            write(out, rows)
            print(rows[-1], flush=True)
    write(out, rows)
    print((out / "acquisition.md").read_text(encoding="utf-8"))


def cell(task: str, representation: str, criterion: str, seed: int) -> Iterator[Row]:
    """One design, with the error of its model each time the queries are as many as ``QUERIES`` says."""
    counts = QUERIES[task, representation]
    spec = _spec(task, representation, criterion, counts[0], seed)
    test = _unseen(task)
    for model, queries in designed(spec, counts):
        yield Row(task, representation, criterion, seed, queries, float(f"{error(model, test):.4g}"), commit())


def designed(spec: EnvironmentSpec, counts: Sequence[int]) -> Iterator[tuple[GaussianProcessModel, int]]:
    """Models of ever more queries. A hypercube is made anew for each number: it can't be added to."""
    definition = definition_from_spec(spec)
    if definition.design.acquisition.name == "latin_hypercube":
        for count in counts:
            yield learn(definition, answer(spec, *arrays(initial_queries(definition, count)))).model, count
        return
    samples, state = answer(spec, *arrays(initial_queries(definition, counts[0]))), DesignState()
    while True:
        next_count = min((count for count in counts if count > len(samples)), default=len(samples))
        wanted = min(next_count - len(samples), len(definition.outputs))
        made = advance(definition, samples, state, Request(len(samples), 0.999, extra=wanted))
        if len(samples) in counts:
            yield made.model, len(samples)
        if not made.queries:
            return
        samples, state = join(samples, answer(spec, *arrays(made.queries))), made.state


def error(model: GaussianProcessModel, test: Samples) -> float:
    """Root mean square over points and outputs, in deviations of each output's change."""
    observe, predicted = model.definition.observe, model.transition(test.q, test.u)
    truth = torch.cat([observe(test.q_next), test.reward[:, None]], -1)
    before = torch.cat([observe(test.q), torch.zeros(len(test), 1)], -1)
    said = torch.cat([observe(predicted.q_next), predicted.reward[:, None]], -1)
    spread = (truth - before).std(0)
    varies = spread > 1e-9
    return float((((said - truth) / spread)[:, varies]).square().mean().sqrt())


def _spec(task: str, representation: str, criterion: str, initial: int, seed: int) -> EnvironmentSpec:
    spec = make(TASKS[task]).spec()
    values = {**DESIGNS[representation], "acquisition": criterion, "initial": initial, "seed": seed}
    design = Design.model_validate(values)
    return spec.model_copy(update={"design": design})


def _unseen(task: str) -> Samples:
    """The same for all designs of a task."""
    spec = make(TASKS[task]).spec()
    definition, steps = definition_from_spec(spec), random_steps(spec, TEST_POINTS, TEST_SEED)
    inside = ~(definition.terminated(steps.q) | definition.terminated(steps.q_next))
    return Samples(*(getattr(steps, field.name)[inside] for field in fields(steps)))


def read(path: Path) -> list[Row]:
    if not path.exists():
        return []
    with path.open(encoding="utf-8", newline="") as lines:
        rows = [Row(**values) for values in csv.DictReader(lines)]
    return [replace(r, seed=int(r.seed), queries=int(r.queries), error=float(r.error)) for r in rows]


def write(out: Path, rows: Sequence[Row]) -> None:
    """rows.csv, the table and the picture."""
    with (out / "rows.csv").open("w", encoding="utf-8", newline="") as lines:
        writer = csv.DictWriter(lines, [field.name for field in fields(Row)])
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)
    (out / "acquisition.md").write_text(table(rows), encoding="utf-8")
    draw(out / "acquisition.png", rows)


def table(rows: Sequence[Row]) -> str:
    """Interquartile mean over seeds of the error's logarithm, raised again, with its 95 % bootstrap interval; and the
    hypercube's over it, and over that with symmetry the one without."""
    lines = [
        "| task | representation | queries | criterion | seeds | error | error of a Latin hypercube over it "
        "| error without symmetry over it |"
    ]
    lines += ["| --- | --- | --- | --- | --- | --- | --- | --- |"]
    for task, representation, queries, criterion in _cases(rows):
        errors, hypercube = (_logs(rows, task, representation, queries, c) for c in (criterion, "latin_hypercube"))
        said = _words(interquartile_mean(errors), bootstrap_interval(errors))
        against = "" if criterion == "latin_hypercube" or not len(hypercube) else _factor(hypercube, errors)
        without = _logs(rows, task, "coordinates", queries, criterion) if representation == "symmetry" else errors[:0]
        gained = _factor(without, errors) if len(without) else ""
        lines.append(
            f"| {task} | {representation} | {queries} | {criterion} | {len(errors)} | {said} | {against} | {gained} |"
        )
    return "\n".join(lines) + "\n"


def draw(path: Path, rows: Sequence[Row]) -> None:
    """Error against queries, a panel for each task and representation."""
    panels = list(dict.fromkeys((row.task, row.representation) for row in rows))
    figure = Figure(figsize=(4.2 * max(1, len(panels)), 3.4), layout="constrained")
    for axes, (task, representation) in zip(
        np.atleast_1d(figure.subplots(1, max(1, len(panels)))), panels, strict=False
    ):
        for criterion in CRITERIA:
            counts = [
                c for c in QUERIES[task, representation] if len(_errors(rows, task, representation, c, criterion))
            ]
            errors = [_logs(rows, task, representation, count, criterion) for count in counts]
            if errors:
                bands = 10 ** np.array([bootstrap_interval(e) for e in errors])
                middle = [10 ** interquartile_mean(e) for e in errors]
                (line,) = axes.plot(counts, middle, marker="o", label=criterion)
                axes.fill_between(counts, bands[:, 0], bands[:, 1], alpha=0.15, color=line.get_color(), linewidth=0)
        axes.set(yscale="log", xlabel="real queries", ylabel="one-step error", title=f"{task}, {representation}")
        axes.legend(frameon=False, fontsize=7)
    figure.savefig(path, dpi=120, metadata={"Software": None})


def _cases(rows: Sequence[Row]) -> list[tuple[str, str, int, str]]:
    """Task, representation, queries and criterion of every line, in their order here."""
    there = {(row.task, row.representation, row.queries, row.criterion) for row in rows}
    ordered = (
        (*key, count, criterion) for key, counts in QUERIES.items() for count in counts for criterion in CRITERIA
    )
    return [case for case in ordered if case in there]


def _errors(rows: Sequence[Row], *case: str | int) -> np.ndarray:
    found = (r.error for r in rows if (r.task, r.representation, r.queries, r.criterion) == case)
    return np.array(list(found))


def _logs(rows: Sequence[Row], *case: str | int) -> np.ndarray:
    """Errors range over many powers of ten, and below 1e-6 of the deviation there is nothing to tell apart."""
    return np.log10(np.maximum(_errors(rows, *case), 1e-6))


def _factor(hypercube: np.ndarray, errors: np.ndarray) -> str:
    return _words(interquartile_mean(hypercube) - interquartile_mean(errors), difference_interval(hypercube, errors))


def _words(middle: float, interval: tuple[float, float]) -> str:
    return f"{10**middle:.2g} ({10 ** interval[0]:.2g} to {10 ** interval[1]:.2g})"


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    parser.add_argument("--representations", nargs="+", choices=DESIGNS, default=list(DESIGNS))
    parser.add_argument("--criteria", nargs="+", choices=CRITERIA, default=list(CRITERIA))
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--out", type=Path, default=Path("runs/acquisition"))
    return parser.parse_args()


if __name__ == "__main__":
    main()
