"""The choice of families by evidence: what it decides, and what the families are worth on other episodes.

python tests/benchmarks/bench_families.py
python tests/benchmarks/bench_families.py --alone --tasks bounce --rows 500
python tests/benchmarks/bench_families.py --tasks bounce --settings '{"candidates": "gaussian_process, ensemble"}'

``pendulum`` is smooth; its few samples are single steps from anywhere. ``bounce`` is a ball that is pushed on a line
between two hard walls, and loses some speed when it hits one within a step: the change of its speed jumps. ``contact``
is the unseen task of this name. Their samples are episodes of 50 random actions that hold for a few steps.

Every log is fitted by ``selected`` once, so the comparison decides at once. Then each candidate is fitted to the whole
log and scored on 40 fresh episodes (for ``pendulum``, too) by the same scores: log density after 1, 5 and 20 steps in
nats, of values in deviations of the output's change, and coverage of 90 % intervals. A choice counts as wrong if a
rival is clearly better there by the rule of the choice: by more than twice the standard error, with a coverage that is
clearly no worse by more than 5 points. It also counts as wrong if it lost coverage: it is inside more seldom than the
first candidate by more than 5 points there. The time is processor time of the fit. With ``--alone`` nothing is chosen:
each candidate is only fitted to the whole log and scored on the fresh episodes.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
import torch
from common import parser, started, write

from surrogym_client.experiments.unseen.machine import Machine
from surrogym_client.experiments.unseen.tasks import Contact
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.samples import Samples, increments
from surrogym_server.models.port import DynamicsModel
from surrogym_server.models.selected import SelectedFamilies
from surrogym_server.models.selected.learning import compared
from surrogym_server.models.selected.scores import Scores, scores
from surrogym_server.models.selected.selection import COVERAGE_LOSS
from surrogym_shared.spec import ModelChoice

Array = np.ndarray[Any, Any]

EPISODE, FRESH, HELD = 50, 40, 5  # steps of an episode, fresh episodes, and steps that an action holds
MARGIN = 2.0


class Pendulum(Machine):
    """A pendulum with a motor."""

    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {"angle": (-math.pi, math.pi), "speed": (-6, 6)}
    start: ClassVar[Mapping[str, tuple[float, float]]] = ranges
    angles = ("angle",)

    def formula(self, q: Array, u: Array) -> tuple[Array, Array]:
        angle, speed = q[..., 0], q[..., 1]
        speed = 0.98 * speed + 0.05 * (10 * np.sin(angle) + 4 * u[..., 0])
        after = np.stack([(angle + 0.05 * speed + np.pi) % (2 * np.pi) - np.pi, speed], -1)
        return after, np.cos(angle) - 0.01 * u[..., 0] ** 2


class Bounce(Machine):
    """A ball that is pushed between two walls."""

    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {"place": (-1, 1), "speed": (-3, 3)}
    start: ClassVar[Mapping[str, tuple[float, float]]] = ranges

    def formula(self, q: Array, u: Array) -> tuple[Array, Array]:
        speed = 0.98 * q[..., 1] + 0.4 * u[..., 0]
        place = q[..., 0] + 0.1 * speed
        hits = np.abs(place) > 1
        place = np.where(hits, 2 * np.sign(place) - place, place)
        return np.stack([place, np.where(hits, -0.8 * speed, speed)], -1), -((q[..., 0] - 0.5) ** 2)


TASKS: dict[str, type[Machine]] = {"pendulum": Pendulum, "bounce": Bounce, "contact": Contact}
ROWS = {"pendulum": [30], "bounce": [500, 1_000], "contact": [500, 1_000]}


def episodes(machine: Machine, count: int, rng: np.random.Generator) -> Samples:
    """Episodes from random starts under random actions."""
    low, high = np.array(list(machine.start.values())).T
    q, steps = rng.uniform(low, high, (count, len(low))), []
    for step in range(EPISODE):
        u = rng.uniform(-1, 1, (count, machine.actions)) if step % HELD == 0 else u  # noqa: F821
        after, pay = machine.formula(q, u)
        steps.append((q, u, after, pay))
        q = after
    return samples_of(*(np.stack(part, 1) for part in zip(*steps, strict=True)))


def anywhere(machine: Machine, count: int, rng: np.random.Generator) -> Samples:
    """Single steps from anywhere."""
    low, high = np.array(list(machine.ranges.values())).T
    q, u = rng.uniform(low, high, (count, len(low))), rng.uniform(-1, 1, (count, machine.actions))
    return samples_of(q, u, *machine.formula(q, u))


def samples_of(q: Array, u: Array, after: Array, pay: Array) -> Samples:
    parts = [torch.from_numpy(np.ascontiguousarray(a.reshape(-1, a.shape[-1]))) for a in (q, u, after)]
    return Samples(*parts, torch.from_numpy(pay.reshape(-1)), torch.zeros(pay.size, dtype=torch.bool))


def measured(task: str, rows: int, log: int, settings: Mapping[str, Any]) -> dict[str, Any]:
    """What was chosen with one log, and how the candidates do on fresh episodes."""
    machine, rng = TASKS[task](), np.random.default_rng([log, rows])
    samples = anywhere(machine, rows, rng) if task == "pendulum" else episodes(machine, rows // EPISODE, rng)
    fresh = episodes(machine, FRESH, rng)
    spec = machine.spec()
    choice = ModelChoice(name="selected", settings=dict(settings))
    spec = spec.model_copy(update={"design": spec.design.model_copy(update={"model": choice})})
    definition, family = definition_from_spec(spec), SelectedFamilies(**settings)
    begun = time.process_time()
    model = family.learn(definition, samples).model
    seconds = time.process_time() - begun
    alone = {name: learner.learn(definition, samples).model for name, learner in family.learners.items()}
    selection = model.description["selection"]
    judged = {name: on_fresh(definition, one, samples, fresh) for name, one in {**alone, "selected": model}.items()}
    outputs = [
        {
            "output": name,
            "serves": selection["serving"][column],
            "held out": selection["standings"][column],
            "fresh": {family: asdict_of(found[column]) for family, found in judged.items()},
            "better on fresh": better(judged, selection["serving"][column], column),
        }
        for column, name in enumerate(definition.outputs)
    ]
    return {"task": task, "rows": len(samples), "log": log, "held out": selection["held_out"], "outputs": outputs} | {
        "seconds of a fit": seconds
    }


def alone(task: str, rows: int, log: int, settings: Mapping[str, Any]) -> dict[str, Any]:
    """How each candidate does on fresh episodes, without a choice among them."""
    machine, rng = TASKS[task](), np.random.default_rng([log, rows])
    samples = anywhere(machine, rows, rng) if task == "pendulum" else episodes(machine, rows // EPISODE, rng)
    fresh, definition, found = episodes(machine, FRESH, rng), definition_from_spec(machine.spec()), {}
    print(f"{task}, {len(samples)} rows, log {log}")
    for name, learner in SelectedFamilies(**settings).learners.items():
        begun = time.process_time()
        model = learner.learn(definition, samples).model
        seconds = time.process_time() - begun
        judged = on_fresh(definition, model, samples, fresh)
        outputs = {output: asdict_of(one) for output, one in zip(definition.outputs, judged, strict=True)}
        found[name] = {"seconds of a fit": seconds, "fresh": outputs}
        said = ", ".join(f"{output} {one['score']:.2f}, {one['coverage']:.0%}" for output, one in outputs.items())
        print(f"  {name:24}{seconds:6.1f} s a fit; {said} inside")
    return {"task": task, "rows": len(samples), "log": log, "alone": found}


def on_fresh(
    definition: EnvironmentDefinition, model: DynamicsModel, samples: Samples, fresh: Samples
) -> tuple[Scores, ...]:
    scale = torch.cat([increments(definition, samples), samples.reward[:, None]], 1).std(0)
    return scores(model, fresh, torch.arange(len(fresh)).tensor_split(FRESH), scale)


def better(judged: Mapping[str, tuple[Scores, ...]], serving: str, column: int) -> list[str]:
    """Families that would have been better on the fresh episodes, by the rule of the choice."""
    base, found = judged[serving][column], []
    for name, outputs in judged.items():
        rival, had = compared(name, outputs[column], base), compared(serving, base, base)
        if name != "selected" and rival.beats(had, MARGIN):
            found.append(name)
    first = next(iter(judged.values()))[column]
    if float(base.inside.mean()) < float(first.inside.mean()) - COVERAGE_LOSS:
        found.append("coverage is lost")
    return found


def asdict_of(one: Scores) -> dict[str, float]:
    return {"score": float(one.density.mean()), "coverage": float(one.inside.mean())}


def show(row: Mapping[str, Any]) -> None:
    held = row["held out"]
    print(f"{row['task']}, {row['rows']} rows, log {row['log']}: {held['pieces']} {held['kind']} held out", end=" ")
    print(f"in {held['folds']} folds, steps {held['horizons']}; {row['seconds of a fit']:.0f} s a fit")
    for note in held["notes"]:
        print(f"  ({note})")
    for output in row["outputs"]:
        verdict = f"wrong: {', '.join(output['better on fresh'])}" if output["better on fresh"] else "right"
        print(f"  {output['output']}: {output['serves']} serves, {verdict}")
        held_out = {one["family"]: one for one in output["held out"]}
        for family, fresh in output["fresh"].items():
            one = held_out.get(family)
            said = "" if one is None else f"{one['score']:.2f} ({one['better']:+.2f} +- {one['error']:.2f})"
            said += "" if one is None else f", {one['coverage']:.0%} +- {one['coverage_error']:.0%} inside"
            print(f"    {family:24}{said:48} fresh: {fresh['score']:.2f}, {fresh['coverage']:.0%} inside")


def main() -> None:
    made = parser(__doc__)
    made.add_argument("--tasks", choices=TASKS, nargs="*", default=list(TASKS))
    made.add_argument("--rows", type=int, nargs="*", help="of the log; by default as the task needs")
    made.add_argument("--alone", action="store_true", help="score every candidate, and choose none")
    made.add_argument("--settings", default="{}", help="of the family, as JSON")
    made.add_argument("--logs", type=int, nargs="*", default=[0], help="seeds of the logs")
    options = started(made)
    report = []
    for task in options.tasks:
        for rows in options.rows or ROWS[task]:
            for log in options.logs:
                if options.alone:
                    report.append(alone(task, rows, log, json.loads(options.settings)))
                    continue
                report.append(measured(task, rows, log, json.loads(options.settings)))
                show(report[-1])
    write(options.out, "families", {"rows": report})


if __name__ == "__main__":
    main()
