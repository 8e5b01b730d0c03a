"""Whether evidence can choose mirror images of some coordinates, forces that switch on, or parts that are repeated.

python lab/benchmarks/bench_parts.py --structures mirrors gates --seeds 120 121 --sizes 20 40 100
python lab/benchmarks/bench_parts.py --structures repeats --seeds 120 121 122 --sizes 20 30 40
python lab/benchmarks/bench_parts.py --designs --tasks chain rooms tanks --seeds 120 121 122

Models are learned from Latin hypercubes, and each output's process is fitted again with one other structure, as in
``bench_structure.py``, which explains the scores and the table. Tasks: swing-up, double pendulum, Reacher, a chain of
six masses, a row of six rooms, a crane with a hoist, a drone in a plane, four tanks in series, a ball that bounces on a
floor, and a finger that pushes a block.

- *mirrors*: some coordinates and entries of the action change their signs, and an output changes its own sign if it
  is the change of such a coordinate. A position and what moves it change together. All such sets are compared
  with the hyperparameters as they are, and the three best are fitted.
- *gates*: a second squared exponential counts only beyond a threshold of one input (a logistic gate of learned place
  and width). Each input is tried.
- *repeats*: outputs that do the same with inputs of their own share samples, as models are built
  (``learning/repeats.py``).

With ``--designs`` adaptive designs of up to 100 real steps learn with shared samples and without them.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import numpy as np
import torch
from common import parser, started, write
from machines import Ball, Block, Chain, Crane, Drone, Rooms, Tanks
from structures import (
    AS_IT_IS,
    CHOSEN,
    SETTINGS,
    Case,
    Composite,
    case_of,
    definition_of,
    designed,
    hypercube,
    scored,
    table,
    unseen_steps,
)
from torch import Tensor

from support.models import gaussian_processes
from surrogym.demo.tasks import TASKS as DEMOS
from surrogym_sampler.original import make
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.features import features
from surrogym_server.environment.samples import Samples, increments
from surrogym_server.errors import NumericalFailure
from surrogym_server.gp import Reflection
from surrogym_server.gp.search import Evidence, minimum
from surrogym_server.models.gaussian_process.feature_maps import CENTRED
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel
from surrogym_server.plugins import Choice
from surrogym_shared.spec import REWARD

MOVED = 0.9  # correlation of a coordinate's change with another coordinate, by which the two are mirrored together
MOST_GROUPS = 8
FITTED = 3  # mirror images that are fitted
STEEP = (math.log(0.1), 1.0)  # prior of the logarithm of a gate's width, in deviations of its input


OWN: dict[str, Callable[[], Any]] = {
    "chain": Chain, "rooms": Rooms, "crane": Crane, "drone": Drone, "tanks": Tanks, "ball": Ball, "block": Block,
}  # fmt: skip
TASKS = {name: (lambda task=task: make(task.environment)) for name, task in DEMOS.items()} | OWN


@dataclass(frozen=True)
class Learned:
    """A model's outputs, with what a structure needs beside each output's case."""

    definition: EnvironmentDefinition
    groups: list[list[int]]  # entries of [q, u] that are mirrored together


def groups_of(definition: EnvironmentDefinition, samples: Samples) -> list[list[int]]:
    """Groups of entries of [q, u]: a coordinate, and those that move it; each entry of the action alone."""
    change, count = increments(definition, samples), len(definition.coordinates)
    root = list(range(count))
    for column, moved in enumerate(definition.moving):
        for by in range(count):
            pair = torch.stack([change[:, column], samples.q[:, by]])
            if by != moved and float(pair.std(1).min()) > 0 and abs(float(pair.corrcoef()[0, 1])) > MOVED:
                root = [root[moved] if r == root[by] else r for r in root]
    found = [[i for i in range(count) if root[i] == r] for r in dict.fromkeys(root)]
    return found + [[count + entry] for entry in range(definition.action.size)]


def mirrors(made: Learned, output: OutputModel, column: int, case: Case, score: float) -> Iterator[dict[str, Any]]:
    """The best mirror image of some entries, but not of all."""
    if output.feature_map.state == "observation" or len(made.groups) > MOST_GROUPS:
        return
    own = -1 if output.name == REWARD else made.definition.moving[column]
    tried: list[tuple[float, Reflection, list[int]]] = []
    for size in range(1, len(made.groups)):
        for chosen in combinations(made.groups, size):
            entries = [entry for group in chosen for entry in group]
            signs = _signs(made.definition, output, entries)
            parity = -1 if own in entries else 1
            if signs is None or bool((signs > 0).all()):  # no rule, or nothing that turns
                continue
            mirror = Reflection(signs, parity)
            objective = Evidence(case.x, case.y, case.options, mirror)
            tried.append((objective(objective.theta(case.hyper))[0], mirror, entries))
    best: tuple[float, Case, list[int]] | None = None
    for _, mirror, entries in sorted(tried, key=lambda t: t[0])[:FITTED]:
        objective = Evidence(case.x, case.y, case.options, mirror)
        cost, theta = minimum(objective, objective.theta(case.hyper))
        if best is None or -cost > best[0]:
            best = -cost, replace(case, mirror=mirror, hyper=objective.hyper(theta)), entries
    if best is not None:
        gain = best[0] - score - CHOSEN - math.log(len(tried))
        yield {"structure": "mirrors", "of": best[2], "gain": gain, "chosen": gain > 0, **best[1].judged(best[1].hyper)}


def _signs(definition: EnvironmentDefinition, output: OutputModel, entries: Sequence[int]) -> Tensor | None:
    """Signs (d,) of an output's features if these entries of [q, u] change theirs; None if there is no such rule."""
    signs = []
    for feature in features(definition, output.feature_map):
        turned = feature.entry in entries
        if feature.weights:
            moved_by = [i for i, weight in enumerate(feature.weights) if weight]
            if len({i in entries for i in moved_by}) > 1:
                return None
        if not turned or feature.function in ("cos", "turned_cos"):
            signs.append(1)
        elif feature.function in ("sin", "turned_sin", "wrapped") or (
            feature.function == "affine" and abs(feature.centre) <= CENTRED * feature.scale
        ):
            signs.append(-1)
        else:
            return None
    return torch.tensor(signs, dtype=torch.float64)


class Gate(Composite):
    """The process as it is plus a squared exponential behind a gate of one input. Further parameters: place, logarithm
    of the width, length scales, logarithm of the variance."""

    def __init__(self, case: Case, place: int, side: int) -> None:
        self.place, self.side, d = place, side, case.x.shape[1]
        own = [(0.0, 1.0), STEEP, *[(math.log(2.0) + 0.5 * math.log(d), 1.2)] * d, (-1.0, 2.0)]
        lower = np.concatenate([[-2.0, math.log(0.01)], np.full(d, math.log(0.02)), [-18.0]])
        upper = np.concatenate([[2.0, math.log(2.0)], np.full(d, math.log(1e3)), [9.0]])
        super().__init__(case, own, lower, upper)

    def k(self, theta: Tensor, a: Tensor, b: Tensor) -> Tensor:
        squared = (a[:, None] - b[None]) ** 2
        whole = (-0.5 * squared @ torch.exp(-2 * theta[: self.d])).exp() * theta[self.d].exp()
        at, width = theta[self.inner], theta[self.inner + 1].exp()
        open_a, open_b = (torch.sigmoid(self.side * (z[:, self.place] - at) / width) for z in (a, b))
        behind = (-0.5 * squared @ torch.exp(-2 * theta[self.inner + 2 : -1])).exp() * theta[-1].exp()
        return whole + self.polynomial(theta, a, b) + open_a[:, None] * behind * open_b

    def found(self, places: Sequence[float]) -> tuple[float, np.ndarray]:
        """The log evidence and parameters of the best optimum, from gates at several places."""
        start = min(map(self.start, places), key=lambda theta: self(theta)[0])
        value, theta = minimum(self, start)
        return -value, theta


def gates(made: Learned, output: OutputModel, column: int, case: Case, score: float) -> Iterator[dict[str, Any]]:
    """The best gate of one input. Processes with a mirror image have none."""
    del made, output, column
    if case.mirror is not None or len(case.y) < 2 * case.x.shape[1]:
        return
    best: tuple[float, Gate, np.ndarray] | None = None
    tried = 2 * case.x.shape[1]
    for place in range(case.x.shape[1]):
        for side in (1, -1):
            gate = Gate(case, place, side)
            evidence, theta = gate.found((-0.8, 0.0, 0.8))
            if best is None or evidence > best[0]:
                best = evidence, gate, theta
    assert best is not None
    gain = best[0] - score - CHOSEN - math.log(tried)
    yield {"structure": "gates", "of": best[1].place, "gain": gain, "chosen": gain > 0, **best[1].scores(best[2])}


def repeats(definition: EnvironmentDefinition, learned: Samples, unseen: Samples) -> Iterator[dict[str, Any]]:
    """Each output that shares samples, as models are built, and the same without."""
    moved = {}
    for sharing in (False, True):
        settings = {**SETTINGS, "drop_inputs": True, "repeated_parts": sharing}
        choice = Choice("gaussian_process", tuple(settings.items()))
        made = replace(definition, learning=replace(definition.learning, model=choice))
        model = gaussian_processes(made, learned)
        moved[sharing] = model.transition(unseen.q, unseen.u, stds=True)
    size = increments(definition, unseen).std(0, correction=0)
    for column, (index, output) in enumerate(zip(definition.moving, model.transitions, strict=True)):
        for sharing, found in moved.items():
            off = (found.q_next - unseen.q_next)[:, index] / size[column]
            row = scored(off, (found.std[:, index] / size[column]) ** 2)
            shown = {"structure": "repeats" if sharing else AS_IT_IS, "output": f"{output.name} (repeats)"}
            yield {**shown, "of": output.shared, "chosen": bool(output.shared), **row}


SINGLE = {"mirrors": mirrors, "gates": gates}


def rows_of(name: str, sizes: Sequence[int], seeds: Sequence[int], names: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Rows of every output of a task."""
    original = TASKS[name]()
    definition = definition_of(original, SETTINGS)
    unseen = unseen_steps(original, definition)
    for size in sizes:
        for seed in seeds:
            learned = hypercube(original, definition, size, seed)
            model = gaussian_processes(definition, learned)
            made = Learned(definition, groups_of(definition, learned))
            every = []
            for column, output in enumerate(model.outputs):
                found = case_of(definition, output, column, unseen)
                if found is not None:
                    every.append((output, column, *found))
            where = {"task": name, "n": size, "seed": seed}
            for output, column, case, score in every:
                shown = {**where, "output": output.name, "map": str(output.feature_map)}
                yield {**shown, "structure": AS_IT_IS, "gain": 0.0, **case.judged(case.hyper)}
                for structure in names:
                    if structure in SINGLE:
                        try:
                            rows = list(SINGLE[structure](made, output, column, case, score))
                        except NumericalFailure:
                            continue
                        yield from ({**shown, **row} for row in rows)
            if "repeats" in names:
                yield from ({**where, **row} for row in repeats(definition, learned, unseen))


def main() -> None:
    made = parser(__doc__)
    made.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    made.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    made.add_argument("--sizes", type=int, nargs="+", default=[20, 40])
    names = [*SINGLE, "repeats"]
    made.add_argument("--structures", nargs="+", choices=names, default=names)
    made.add_argument("--designs", action="store_true", help="adaptive designs instead of hypercubes")
    options = started(made)
    if options.designs:
        found = []
        for task, seed, sharing in product(options.tasks, options.seeds, (True, False)):
            row = designed(TASKS[task](), seed, {"repeated_parts": sharing})
            found.append({"task": task, "seed": seed, "sharing": sharing, **row})
            print(found[-1])
        write(options.out, "parts-designs", {"rows": found})
        return
    every = []
    for task in options.tasks:
        begun = time.perf_counter()
        rows = list(rows_of(task, options.sizes, options.seeds, options.structures))
        every += rows
        write(options.out, f"parts-{task}", {"rows": rows})
        print(f"{task}: {len(rows)} rows, {time.perf_counter() - begun:.0f} s")
        print("\n".join(table(rows)))
    print("all")
    print("\n".join(table(every)))


if __name__ == "__main__":
    main()
