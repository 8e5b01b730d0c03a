"""What prequential scores say of whole designs: whether a verdict on them, or a factor on deviations, would be right.

A design of each task and seed runs to its end, as a server would run it. Each new sample is predicted before it is
learned from, by the process' own deviation and by the mixture over uncertain hyperparameters. Fresh real steps from
anywhere show how good the last model is. A model is taken as wrong if the 90 % interval or the tolerance holds less
than ``RIGHT`` of an output's fresh steps. The verdict is an exact binomial test of the last 20 predictions. The factor
widens deviations until 90 % of them are inside. With ``--judged`` a ready design takes one more real step at a time
while the verdict names an output.

Run it by::

    python lab/benchmarks/bench_prequential.py --seeds 5 --first-seed 3000
"""

from __future__ import annotations

import sys
from dataclasses import asdict, dataclass, replace
from math import ceil
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import numpy as np
import torch
from common import parser, started, write
from scipy.stats import binom

from support.real_steps import arrays, join, samples_of
from surrogym_lab.tasks import EVERY_TASK
from surrogym_sampler.original import make
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.samples import Samples
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.models.gaussian_process.prediction.several import FunctionsOfSeveral
from surrogym_server.models.port import DynamicsModel
from surrogym_server.sampling.design import Decision, advance, initial_queries
from surrogym_server.sampling.latin_hypercube import random_points
from surrogym_server.sampling.prequential import Prediction, Predictions, half_width, latest, predicted, scores_of
from surrogym_server.sampling.state import DesignState, Request
from surrogym_shared.spec import EnvironmentSpec

TASKS = ("pendulum", "cartpole", "mountaincar", "stick-slip", "swingup", "acrobot")
BUDGET = {"pendulum": 20, "cartpole": 20, "mountaincar": 20}  # of designs that end before; others have their task's
FRESH, FRESH_SEED = 300, 40_000
FEWEST, RIGHT, LEVEL = 5, 0.85, 0.9
HALF = half_width(LEVEL)  # in deviations


@dataclass(frozen=True)
class Row:
    """One output of one design. Pairs are of the process' own deviation and of the mixture."""

    task: str
    seed: int
    verdict: str
    steps: int
    output: str
    predictions: int
    inside: tuple[int, int]  # of the predictions
    chance: tuple[float, float]  # of as few inside if intervals are right
    fresh: tuple[float, float]  # share inside
    factor: float  # on the process' own deviation
    fresh_with_factor: float
    scores: tuple[float, float]  # interval scores of fresh steps over the tolerance, without and with the factor


class Machine:
    """An original environment, and what it answers."""

    def __init__(self, environment: str, seed: int) -> None:
        self._original = make(environment)
        spec = self._original.spec()
        self.spec: EnvironmentSpec = spec.model_copy(update={"design": spec.design.model_copy(update={"seed": seed})})

    def answer(self, q: torch.Tensor, u: torch.Tensor) -> Samples:
        steps = [self._original.step_from(*point) for point in zip(q.numpy(), u.numpy(), strict=True)]
        return samples_of(steps)


def rows_of(task: str, seed: int, *, judged: bool) -> list[Row]:
    machine = Machine(EVERY_TASK[task].environment, seed)
    made, samples, mixed = replay(machine, BUDGET.get(task, EVERY_TASK[task].budget), judged=judged)
    points = random_points(made.model.definition, FRESH, np.random.default_rng(FRESH_SEED))
    fresh = machine.answer(*points)
    own, mixture = predicted(made.model, fresh), mixture_of(made.model, fresh)
    rows = []
    for i, output in enumerate(made.model.definition.outputs):
        tolerance, kept = made.tolerances[i], made.state.predictions[i] if made.state.predictions else ()
        if not kept:
            continue
        inside = tuple(int(_inside(one, tolerance).sum()) for one in (kept, mixed[i]))
        factor = _factor(kept, tolerance)
        wide = [Prediction(p.error, factor * p.std) for p in own[i]]
        found = scores_of(own[i], tolerance), scores_of(wide, tolerance)
        if found[0] is None or found[1] is None:
            continue
        rows.append(
            Row(
                *(task, seed, made.verdict, len(samples), output, len(kept), (inside[0], inside[1])),
                (_chance(inside[0], len(kept)), _chance(inside[1], len(kept))),
                (found[0].within_90, float(_inside(mixture[i], tolerance).mean())),
                *(factor, found[1].within_90, (found[0].interval_score, found[1].interval_score)),
            )
        )
    return rows


def replay(machine: Machine, budget: int, *, judged: bool) -> tuple[Decision, Samples, Predictions]:
    """The last round of a design, its samples, and the predictions of the mixture."""
    definition = definition_from_spec(machine.spec)
    samples, state, mixed = machine.answer(*arrays(initial_queries(definition, budget))), DesignState(), Predictions()
    while True:
        request = Request(budget, machine.spec.design.target)
        made = advance(definition, samples, state, request)
        if judged and made.verdict == "ready" and len(samples) < budget and _miscalibrated(made):
            made = advance(definition, samples, state, replace(request, extra=1))
        if not made.queries:
            return made, samples, mixed
        new = machine.answer(*arrays(made.queries))
        state = replace(made.state, predictions=latest(made.state.predictions, predicted(made.model, new)))
        mixed = latest(mixed, mixture_of(made.model, new))
        samples = join(samples, new)


def _miscalibrated(made: Decision) -> bool:
    cases = zip(made.state.predictions, made.tolerances, strict=False)
    found = [(int(_inside(kept, tolerance).sum()), len(kept)) for kept, tolerance in cases]
    return any(count >= FEWEST and _chance(inside, count) < 0.01 for inside, count in found)


def mixture_of(model: DynamicsModel, samples: Samples) -> Predictions:
    """Mean and deviation of the mixture over uncertain hyperparameters."""
    assert isinstance(model, GaussianProcessModel)
    functions = model.uncertain_functions
    if not isinstance(functions, FunctionsOfSeveral):
        return predicted(model, samples)
    each = [predicted(one, samples) for one in functions.models if isinstance(one, GaussianProcessModel)]
    return tuple(tuple(map(_mixed, zip(*output, strict=True))) for output in zip(*each, strict=True))


def _mixed(parts: tuple[Prediction, ...]) -> Prediction:
    errors, stds = np.array([p.error for p in parts]), np.array([p.std for p in parts])
    return Prediction(float(errors.mean()), float(np.sqrt(np.mean(stds**2) + errors.var())))


def _inside(predictions: tuple[Prediction, ...], tolerance: float) -> np.ndarray:
    return np.array([abs(p.error) <= max(HALF * p.std, tolerance) for p in predictions])


def _factor(predictions: tuple[Prediction, ...], tolerance: float) -> float:
    needed = [abs(p.error) / max(HALF * p.std, 1e-300) if abs(p.error) > tolerance else 0 for p in predictions]
    return max(1.0, sorted(needed)[ceil(LEVEL * len(needed)) - 1])


def _chance(inside: int, predictions: int) -> float:
    return float(binom.cdf(inside, predictions, LEVEL))


def table(rows: list[Row]) -> str:
    """A line for each task: designs that the verdict would call miscalibrated, of right and of wrong models."""
    lines = ["| task | models | designs | named at 1 % | named at 5 % | named at 1 %, mixture | fewest inside |"]
    lines.append("|---|---|---|---|---|---|---|")
    designs: dict[tuple[str, int], list[Row]] = {}
    for row in rows:
        designs.setdefault((row.task, row.seed), []).append(row)
    for task in dict.fromkeys(row.task for row in rows):
        for right in (True, False):
            chosen = [d for (name, _), d in designs.items() if name == task and _right(d) == right]
            if chosen:
                named = (_named(chosen, *case) for case in ((0, 0.01), (0, 0.05), (1, 0.01)))
                worst = min((row for design in chosen for row in design), key=lambda row: row.chance[0])
                fewest = f"{worst.inside[0]} of {worst.predictions} ({worst.output}, seed {worst.seed})"
                said = " | ".join(map(str, named))
                lines.append(f"| {task} | {'right' if right else 'wrong'} | {len(chosen)} | {said} | {fewest} |")
    return "\n".join(lines)


def _right(design: list[Row]) -> bool:
    return all(row.fresh[0] >= RIGHT for row in design)


def _named(designs: list[list[Row]], way: int, level: float) -> int:
    return sum(any(r.predictions >= FEWEST and r.chance[way] < level for r in design) for design in designs)


def widened(rows: list[Row]) -> str:
    """A line for each output whose deviations the factor would change, with enough predictions."""
    lines = ["| task, seed | output | inside | factor | fresh inside, before | after | score, before | after |"]
    lines.append("|---|---|---|---|---|---|---|---|")
    for r in rows:
        if r.predictions >= FEWEST and r.factor > 1:
            shares = " | ".join(f"{100 * share:.0f} %" for share in (r.fresh[0], r.fresh_with_factor))
            said = f"{r.inside[0]} of {r.predictions} | {r.factor:.2g} | {shares}"
            lines.append(f"| {r.task}, {r.seed} | {r.output} | {said} | {r.scores[0]:.3g} | {r.scores[1]:.3g} |")
    return "\n".join(lines)


def main() -> None:
    made = parser(__doc__)
    made.add_argument("--tasks", nargs="+", choices=EVERY_TASK, default=list(TASKS))
    made.add_argument("--seeds", type=int, default=5)
    made.add_argument("--first-seed", type=int, default=3000)
    made.add_argument("--judged", action="store_true", help="take real steps while the verdict names an output")
    options = started(made)
    rows: list[Row] = []
    for task in options.tasks:
        for seed in range(options.first_seed, options.first_seed + (1 if options.quick else options.seeds)):
            rows += rows_of(task, seed, judged=options.judged)
            print(f"{task} {seed}: {rows[-1].verdict} after {rows[-1].steps} real steps")
    print(f"{table(rows)}\n\n{widened(rows)}")
    found: dict[str, Any] = {"rows": [asdict(row) for row in rows]}
    write(options.out, "prequential", found)


if __name__ == "__main__":
    main()
