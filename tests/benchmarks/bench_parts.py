"""Whether evidence can choose mirror images of some coordinates, forces that switch on, or parts that are repeated.

python tests/benchmarks/bench_parts.py --structures mirrors gates --seeds 120 121 --sizes 20 40 100
python tests/benchmarks/bench_parts.py --structures repeats --seeds 120 121 122 --sizes 20 30 40
python tests/benchmarks/bench_parts.py --designs --tasks chain rooms tanks --seeds 120 121 122

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
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from pathlib import Path
from typing import Any, ClassVar

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
import torch
from bench_structure import (
    AS_IT_IS,
    BUDGET,
    CHOSEN,
    FLOOR,
    SETTINGS,
    UNSEEN,
    UNSEEN_SEED,
    Case,
    Chain,
    Rooms,
    _steps,
    case_of,
    table,
)
from common import parser, started, write
from torch import Tensor

from support.models import gaussian_processes
from support.real_steps import join
from surrogym_client.experiments.tasks import TASKS as DEMOS
from surrogym_client.experiments.unseen.machine import Machine
from surrogym_client.original import make
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.definition import REWARD, EnvironmentDefinition
from surrogym_server.environment.features import features
from surrogym_server.environment.points import Points
from surrogym_server.environment.samples import Samples, increments
from surrogym_server.errors import NumericalFailure
from surrogym_server.gp import Reflection
from surrogym_server.gp.fit import _minimum, _Objective
from surrogym_server.models.gaussian_process.feature_maps import CENTRED
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel
from surrogym_server.plugins import Choice
from surrogym_server.sampling.design import DesignState, Request, advance, initial_design
from surrogym_server.sampling.latin_hypercube import going_on, latin_hypercube, random_points
from surrogym_server.sampling.prequential import half_width
from surrogym_shared.spec import Design, Reward

MOVED = 0.9  # correlation of a coordinate's change with another coordinate, by which the two are mirrored together
MOST_GROUPS = 8
FITTED = 3  # mirror images that are fitted
STEEP = (math.log(0.1), 1.0)  # prior of the logarithm of a gate's width, in deviations of its input


class Crane(Machine):
    """A crane on a rail with a load on a rope, which a hoist makes longer and shorter."""

    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {
        "x": (-1, 1), "rope": (1, 3), "swing": (-0.8, 0.8), "dx": (-2, 2), "drope": (-1, 1), "dswing": (-2, 2),
    }  # fmt: skip
    start: ClassVar[Mapping[str, tuple[float, float]]] = ranges
    actions: ClassVar[int] = 2

    def formula(self, q: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, rope, swing, dx, drope, dswing = np.moveaxis(q, -1, 0)
        push, hoist = 4 * u[..., 0] - 0.5 * dx, 2 * u[..., 1] - 0.5 * drope
        turn = -(9.81 * np.sin(swing) + push * np.cos(swing) + 2 * drope * dswing) / rope
        dx, drope, dswing = dx + 0.05 * push, drope + 0.05 * hoist, dswing + 0.05 * turn
        after = np.stack([x + 0.05 * dx, rope + 0.05 * drope, swing + 0.05 * dswing, dx, drope, dswing], -1)
        return after, -(x**2) - (rope - 2) ** 2 - swing**2


class Drone(Machine):
    """A drone with two rotors in a vertical plane."""

    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {
        "x": (-1, 1), "z": (-1, 1), "roll": (-1, 1), "dx": (-2, 2), "dz": (-2, 2), "droll": (-3, 3),
    }  # fmt: skip
    start: ClassVar[Mapping[str, tuple[float, float]]] = ranges
    actions: ClassVar[int] = 2  # the sum of the rotors' forces, and their difference

    def formula(self, q: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, z, roll, dx, dz, droll = np.moveaxis(q, -1, 0)
        lift = 10 + 6 * u[..., 0]
        dx = dx + 0.05 * (-lift * np.sin(roll) - 0.3 * dx * np.abs(dx))
        dz = dz + 0.05 * (lift * np.cos(roll) - 10 - 0.3 * dz * np.abs(dz))
        droll = droll + 0.05 * (8 * u[..., 1] - 0.2 * droll)
        after = np.stack([x + 0.05 * dx, z + 0.05 * dz, roll + 0.05 * droll, dx, dz, droll], -1)
        return after, -(x**2) - z**2 - roll**2


class Tanks(Machine):
    """Four tanks in series, each of which drains into the next. The first is filled by a pump."""

    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {f"level{i}": (0.1, 1) for i in range(4)}
    start: ClassVar[Mapping[str, tuple[float, float]]] = ranges

    def formula(self, q: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        out = 0.2 * np.sqrt(q)
        into = np.concatenate([0.1 + 0.1 * u[..., :1], out[..., :-1]], -1)
        return q + into - out, -((q - 0.5) ** 2).sum(-1)


class Ball(Machine):
    """A ball above a springy floor, on a plate that pushes it up and down from afar."""

    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {"height": (-0.1, 1), "speed": (-3, 3)}
    start: ClassVar[Mapping[str, tuple[float, float]]] = ranges

    def formula(self, q: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        height, speed = np.moveaxis(q, -1, 0)
        for _ in range(10):
            force = np.where(height < 0, -400 * height - 4 * speed, 0.0)
            speed = speed + 0.003 * (2 * u[..., 0] - 9.81 + force)
            height = height + 0.003 * speed
        return np.stack([height, speed], -1), -((height - 0.5) ** 2)


class Block(Machine):
    """A finger pushes a block along a table once it touches it; the block slides with friction."""

    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {
        "finger": (-1, 1), "block": (-1, 1), "dfinger": (-1, 1), "dblock": (-1, 1),
    }  # fmt: skip
    start: ClassVar[Mapping[str, tuple[float, float]]] = ranges

    def formula(self, q: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        finger, block, dfinger, dblock = np.moveaxis(q, -1, 0)
        for _ in range(10):
            touch = 60 * np.maximum(finger - block, 0)
            dfinger = dfinger + 0.005 * (5 * u[..., 0] - dfinger - touch)
            dblock = dblock + 0.005 * (touch - 2 * dblock)
            finger, block = finger + 0.005 * dfinger, block + 0.005 * dblock
        return np.stack([finger, block, dfinger, dblock], -1), -((block - 0.5) ** 2)


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
            if signs is None or (parity < 0 and bool((signs > 0).all())) or (parity > 0 and bool((signs > 0).all())):
                continue
            mirror = Reflection(signs, parity)
            objective = _Objective(case.x, case.y, case.options, mirror)
            tried.append((objective(objective.theta(case.hyper))[0], mirror, entries))
    best: tuple[float, Case, list[int]] | None = None
    for _, mirror, entries in sorted(tried, key=lambda t: t[0])[:FITTED]:
        objective = _Objective(case.x, case.y, case.options, mirror)
        cost, theta = _minimum(objective, objective.theta(case.hyper))
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


class Gate:
    """Negative log evidence of the process as it is plus a squared exponential behind a gate of one input, by automatic
    differentiation. Further parameters: place, logarithm of the width, length scales, logarithm of the variance."""

    def __init__(self, case: Case, place: int, side: int) -> None:
        self.case, self.place, self.side = case, place, side
        self.plain, d = _Objective(case.x, case.y, case.options, None), case.x.shape[1]
        own = [(0.0, 1.0), STEEP] + [(math.log(2.0) + 0.5 * math.log(d), 1.2)] * d + [(-1.0, 2.0)]
        self.prior = torch.tensor(np.concatenate([self.plain.prior, own]))
        self.lower = np.concatenate([self.plain.lower, [-2.0, math.log(0.01)], np.full(d, math.log(0.02)), [-18.0]])
        self.upper = np.concatenate([self.plain.upper, [2.0, math.log(2.0)], np.full(d, math.log(1e3)), [9.0]])
        self.inner, self.d, self.options = len(self.plain.prior), d, case.options

    def k(self, theta: Tensor, a: Tensor, b: Tensor) -> Tensor:
        """Latent covariance of a (m, d) and b (n, d)."""
        squared, d = (a[:, None] - b[None]) ** 2, self.d
        whole = (-0.5 * squared @ torch.exp(-2 * theta[:d])).exp() * theta[d].exp()
        if self.case.options.linear:
            whole = whole + theta[d + 1].exp() * (1 + a @ b.T)
        if self.case.options.quadratic:
            whole = whole + theta[self.inner - 2].exp() * (a**2 @ (b**2).T)
        at, width = theta[self.inner], theta[self.inner + 1].exp()
        open_a, open_b = (torch.sigmoid(self.side * (z[:, self.place] - at) / width) for z in (a, b))
        behind = (-0.5 * squared @ torch.exp(-2 * theta[self.inner + 2 : -1])).exp() * theta[-1].exp()
        return whole + open_a[:, None] * behind * open_b

    def loss(self, theta: Tensor) -> Tensor:
        y = self.case.y
        k = self.k(theta, self.case.x, self.case.x) + theta[self.inner - 1].exp() * torch.eye(len(y)).double()
        factor = torch.linalg.cholesky(k)
        white = torch.linalg.solve_triangular(factor, y[:, None], upper=False)
        z = (theta - self.prior[:, 0]) / self.prior[:, 1]
        fixed = 0.5 * len(y) * math.log(2 * math.pi) + self.prior[:, 1].log().sum()
        return 0.5 * white.square().sum() + factor.diagonal().log().sum() + 0.5 * z @ z + fixed

    def __call__(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
        at = torch.tensor(theta, requires_grad=True)
        try:
            value = self.loss(at)
            value.backward()
        except torch.linalg.LinAlgError:
            return 1e10, np.zeros_like(theta)
        assert at.grad is not None
        return float(value.detach()), at.grad.numpy()

    def found(self, places: Sequence[float]) -> tuple[float, np.ndarray]:
        """The log evidence and parameters of the best optimum, from gates at several places."""
        starts = []
        for place in places:
            more = self.prior[self.inner :, 0].numpy().copy()
            more[0] = place
            starts.append(np.concatenate([self.plain.theta(self.case.hyper), more]))
        start = min(starts, key=lambda s: self(s)[0])
        value, theta = _minimum(self, start)
        return -value, theta

    def scores(self, theta: np.ndarray) -> dict[str, float]:
        at, case = torch.from_numpy(theta), self.case
        noise = float(at[self.inner - 1].exp())
        k = self.k(at, case.x, case.x) + noise * torch.eye(len(case.y)).double()
        factor = torch.linalg.cholesky(k)
        across = self.k(at, case.x, case.unseen)
        white = torch.linalg.solve_triangular(factor, torch.cat([case.y[:, None], across], 1), upper=False)
        prior = torch.cat([self.k(at, z[None], z[None])[0] for z in case.unseen])
        variance = (prior - white[:, 1:].square().sum(0)).clamp_min(0) + noise
        return case.scores(white[:, 1:].T @ white[:, 0], variance)


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
        moved[sharing] = model.transition(unseen.q, unseen.u, deviations=True)
    size = increments(definition, unseen).std(0, correction=0)
    for column, (index, output) in enumerate(zip(definition.moving, model.transitions, strict=True)):
        for sharing, found in moved.items():
            off = (found.q_next - unseen.q_next)[:, index] / size[column]
            variance = (found.deviation[:, index] / size[column]) ** 2 + FLOOR**2
            density = -0.5 * (off.square() / variance + (2 * math.pi * variance).log())
            row = {"error": float(off.square().mean().sqrt()), "density": float(density.mean())}
            row["coverage"] = float((off.abs() <= half_width(0.9) * variance.sqrt()).double().mean())
            shown = {"structure": "repeats" if sharing else AS_IT_IS, "output": f"{output.name} (repeats)"}
            yield {**shown, "of": output.shared, "chosen": bool(output.shared), **row}


SINGLE = {"mirrors": mirrors, "gates": gates}


def rows_of(name: str, sizes: Sequence[int], seeds: Sequence[int], names: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Rows of every output of a task."""
    original = TASKS[name]()
    design = Design.model_validate({"model": {"name": "gaussian_process", "settings": SETTINGS}})
    spec = original.spec().model_copy(update={"design": design, "reward": Reward()})
    definition = definition_from_spec(spec)
    rng = np.random.default_rng(UNSEEN_SEED)
    unseen = _steps(original, *going_on(definition, *random_points(definition, UNSEEN, rng), rng))
    for size in sizes:
        for seed in seeds:
            rng = np.random.default_rng(seed)
            learned = _steps(original, *going_on(definition, *latin_hypercube(definition, size, rng), rng))
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


def designed(name: str, seed: int, sharing: bool) -> dict[str, Any]:
    """An adaptive design without a policy, with shared samples or without."""
    original = TASKS[name]()
    model = {"name": "gaussian_process", "settings": {"repeated_parts": sharing}}
    design = Design.model_validate({"seed": seed, "model": model})
    definition = definition_from_spec(original.spec().model_copy(update={"design": design, "reward": Reward()}))
    unseen = _steps(original, *random_points(definition, UNSEEN, np.random.default_rng(UNSEEN_SEED)))
    samples, state = _steps(original, *initial_design(definition, BUDGET)), DesignState()
    nothing, begun = Points(samples.q[:0], samples.u[:0]), time.process_time()
    while len((made := advance(definition, samples, state, Request(BUDGET, 0.999, nothing))).q):
        samples, state = join(samples, _steps(original, made.q, made.u)), made.state
    off = made.model.transition(unseen.q, unseen.u).q_next - unseen.q_next
    error = float((off[:, definition.moving] / increments(definition, unseen).std(0)).square().mean().sqrt())
    took = time.process_time() - begun
    return {"task": name, "seed": seed, "sharing": sharing, "real steps": len(samples), "error": error, "seconds": took}


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
            found.append(designed(task, seed, sharing))
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
