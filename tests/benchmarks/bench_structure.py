"""Whether evidence can choose which inputs an output reads, sums of functions of few inputs, or further features.

python tests/benchmarks/bench_structure.py --fewer --seeds 106 107 108
python tests/benchmarks/bench_structure.py --seeds 100 --sizes 10 20 40
python tests/benchmarks/bench_structure.py --seeds 100 101 --sizes 10 20 40 --structures ratios
python tests/benchmarks/bench_structure.py --designs --tasks chain rooms --seeds 110 111 112

Models are learned from Latin hypercubes of 13 tasks: the nine of the efficiency study, the reactor, the fermenter, a
chain of six masses with cubic springs, and a row of six rooms. Each output's process is then fitted again, on the same
points and feature map, with one other structure at a time. Scores are on unseen steps: root mean square error in
deviations of the output, mean log density in these units, and coverage of the 90 % interval. Deviations of predictions
count as at least ``FLOOR``, so that what is known exactly does not outweigh the rest. ``gain`` is the log evidence of
the structure, hyperparameters' priors included, above that of the process as it is.

The table has, for each structure and number of samples, the outputs where it was chosen, and there the ratio of errors
(geometric mean), the growth of the log density, how often this was above 0.1 and below -0.1, and coverage before and
after. "fewer inputs, as built" is the rule of the product, see ``learning/dropping.py``. Three tasks need MuJoCo.

With ``--designs`` adaptive designs of up to 100 real steps learn with the rule and without it. Their rows have the real
steps after which they ended, and the error of the transition on unseen steps in deviations of a step.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, ClassVar

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
import torch
from common import parser, started, write
from torch import Tensor

from support.fermenter import Fermenter
from support.models import gaussian_processes
from support.reactor import example
from support.real_steps import join
from surrogym_client.experiments.tasks import TASKS as DEMOS
from surrogym_client.experiments.unseen.machine import Machine
from surrogym_client.original import make
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.definition import REWARD, EnvironmentDefinition, wrap
from surrogym_server.environment.features import encode, features, leading
from surrogym_server.environment.points import Points
from surrogym_server.environment.samples import Samples, increments
from surrogym_server.errors import NumericalFailure
from surrogym_server.gp import FitOptions, Fitted, Reflection, condition, fit
from surrogym_server.gp.fit import _minimum, _Objective
from surrogym_server.gp.kernel import Hyperparameters
from surrogym_server.gp.posterior import Posterior
from surrogym_server.gp.selection import select_inputs
from surrogym_server.models.gaussian_process.censoring import usable
from surrogym_server.models.gaussian_process.feature_maps import reflection
from surrogym_server.models.gaussian_process.learning.dropping import FEWEST, LESS, ODDS, WIN
from surrogym_server.models.gaussian_process.learning.many import EXPLAINED
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel
from surrogym_server.sampling.design import DesignState, Request, advance, initial_design
from surrogym_server.sampling.latin_hypercube import going_on, latin_hypercube, random_points
from surrogym_server.sampling.prequential import half_width
from surrogym_shared.spec import Design, Reward

SIZES, UNSEEN, UNSEEN_SEED, BUDGET = (10, 20, 40, 100), 500, 99, 100
CHOSEN = 3.0  # nats of evidence by which a structure other than fewer inputs must win
AS_IT_IS = "as it is"
FLOOR = 0.01  # of the output's deviation on unseen steps
SUMS = ("additive", "state + action")
PAIRS, MOST_FOR_PAIRS = ("products", "ratios"), 8  # inputs; more have too many pairs
SETTINGS = {
    "reward_jumps": False,
    "reward_peaks": False,
    "drop_inputs": False,
}  # the reward is its process, so that it can be fitted again


class Chain(Machine):
    """Six masses in a row between walls, joined by springs that stiffen with the cube; the third is pushed."""

    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {
        f"{kind}{i}": (-1, 1) for kind in ("x", "v") for i in range(6)
    }
    start: ClassVar[Mapping[str, tuple[float, float]]] = ranges

    def formula(self, q: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, v = q[..., :6], q[..., 6:]
        walls = np.zeros_like(x[..., :1])
        stretch = np.diff(np.concatenate([walls, x, walls], -1), axis=-1)
        force = np.diff(stretch + 3 * stretch**3, axis=-1) - 0.2 * v
        force[..., 2] += 3 * u[..., 0]
        after = v + 0.1 * force
        return np.concatenate([x + 0.1 * after, after], -1), -(x**2).sum(-1) - 0.1 * u[..., 0] ** 2


class Rooms(Machine):
    """Six rooms in a row that exchange heat with their neighbours, the more the larger the difference. The first is
    heated."""

    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {f"T{i}": (-1, 1) for i in range(6)}
    start: ClassVar[Mapping[str, tuple[float, float]]] = ranges

    def formula(self, q: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        over = np.diff(q, axis=-1)
        flow, nothing = 0.15 * over + 0.1 * over * np.abs(over), np.zeros_like(q[..., :1])
        after = q + np.diff(np.concatenate([nothing, flow, nothing], -1), axis=-1)
        after[..., 0] += 0.2 * u[..., 0] * (1.5 - q[..., 0])
        return after, -(q**2).sum(-1)


def _tasks() -> dict[str, Callable[[], Any]]:
    tasks: dict[str, Callable[[], Any]] = {
        name: (lambda task=task: make(task.environment)) for name, task in DEMOS.items()
    }
    return tasks | {"reactor": example().Reactor, "fermenter": Fermenter, "chain": Chain, "rooms": Rooms}


@dataclass(frozen=True)
class Case:
    """One output: its standardised points, its unseen steps with the factor of their targets, and what a fit takes."""

    x: Tensor  # (n, d)
    y: Tensor  # (n,)
    unseen: Tensor  # (m, d)
    truth: Tensor  # (m,) standardised as y
    factor: Tensor  # (m,) deviations of the output on unseen steps in one unit of y
    options: FitOptions
    mirror: Reflection | None
    action: Tensor  # (d,) bool, which inputs are features of the action
    may: Tensor  # (d,) bool, which inputs may be left out
    hyper: Hyperparameters

    def only(self, kept: Tensor) -> Case:
        """The case with some of the inputs, ``kept`` (d,) bool."""
        mirror = None if self.mirror is None else replace(self.mirror, signs=self.mirror.signs[kept])
        hyper = replace(self.hyper, lengthscale=self.hyper.lengthscale[kept], reflection=mirror)
        x, unseen, action = self.x[:, kept], self.unseen[:, kept], self.action[kept]
        return replace(self, x=x, unseen=unseen, action=action, may=self.may[kept], mirror=mirror, hyper=hyper)

    def further(self, more: Callable[[Tensor], Tensor]) -> Case:
        """The case with further inputs; those of mirror images have the signs of what they are made of."""
        mirror = self.mirror
        if mirror is not None:
            probe = torch.full_like(self.x[:1], 0.7)
            signs = (more(probe * mirror.signs) * more(probe)).sign()[0]
            mirror = replace(mirror, signs=torch.cat([mirror.signs, signs]))
        x, unseen = (torch.cat([z, more(z)], 1) for z in (self.x, self.unseen))
        action = torch.cat([self.action, torch.zeros(x.shape[1] - len(self.action), dtype=torch.bool)])
        return replace(self, x=x, unseen=unseen, action=action, mirror=mirror)

    def scores(self, mean: Tensor, variance: Tensor) -> dict[str, float]:
        """Scores of predictions (m,) of the unseen steps, noise included."""
        off = (mean - self.truth) * self.factor
        variance = variance * self.factor**2 + FLOOR**2
        density = -0.5 * (off.square() / variance + (2 * math.pi * variance).log())
        covered = (off.abs() <= half_width(0.9) * variance.sqrt()).double()
        return {
            "error": float(off.square().mean().sqrt()),
            "density": float(density.mean()),
            "coverage": float(covered.mean()),
        }

    def judged(self, hyper: Hyperparameters) -> dict[str, float]:
        """Scores of the process with these hyperparameters."""
        mean, variance = condition(hyper, self.x, self.y).mean_and_variance(self.unseen)
        return self.scores(mean, variance + hyper.noise_variance)

    def fitted(self) -> Fitted:
        """Fit as products do."""
        return fit(self.x, self.y, self.options, reflection=self.mirror)


def fewer(case: Case, posterior: Posterior) -> Iterator[dict[str, Any]]:
    """Backward elimination: by evidence alone, and as it is built."""
    found = select_inputs(posterior, case.options, case.may, ODDS)
    left, less = found.kept.nonzero()[:, 0].tolist(), case.only(found.kept)
    row = {"left": left, "gain": found.gain, "chosen": len(left) < len(found.kept)} | less.judged(found.hyper)
    yield {"structure": "fewer inputs, by evidence", **row}
    before, after = (made.left_out.error for made in (posterior, condition(found.hyper, less.x, less.y)))
    wins = found.gain > WIN * len(case.y) and len(case.y) >= FEWEST and before > EXPLAINED and after <= LESS * before
    wins = wins and not case.options.quadratic  # the reward keeps all inputs
    yield {"structure": "fewer inputs, as built", **row, "chosen": row["chosen"] and wins}


class Sum:
    """Negative log evidence of the process as it is plus squared exponentials of groups of inputs, by automatic
    differentiation. The groups share one variance, and have length scales of their own. Each group counts equally."""

    def __init__(self, case: Case, groups: Sequence[Sequence[int]]) -> None:
        self.case, self.groups = case, [list(group) for group in groups if len(group)]
        plain = _Objective(case.x, case.y, case.options, case.mirror)
        self.plain, d = plain, case.x.shape[1]
        own = [(math.log(2.0) + 0.5 * math.log(len(group)), 1.2) for group in self.groups for _ in group]
        self.places = [j for group in self.groups for j in group]
        self.prior = torch.tensor(np.concatenate([plain.prior, own, [(-2.0, 2.0)]]))
        self.lower = np.concatenate([plain.lower, np.full(len(own), math.log(0.02)), [math.log(1e-8)]])
        self.upper = np.concatenate([plain.upper, np.full(len(own), math.log(1e3)), [math.log(1e4)]])
        self.options, self.inner, self.d = case.options, len(plain.prior), d

    def k(self, theta: Tensor, a: Tensor, b: Tensor) -> Tensor:
        """Latent covariance of a (m, d) and b (n, d)."""
        made = self._parts(theta, a, b)
        mirror = self.case.mirror
        if mirror is not None:
            made = made + mirror.parity * self._parts(theta, a, b * mirror.signs)
        linear = theta[self.d + 1].exp() if self.options.linear else 0.0
        quadratic = theta[self.inner - 2].exp() if self.options.quadratic else 0.0
        kept = torch.ones(self.d, dtype=torch.float64) if mirror is None else mirror.kept
        even = 1.0 if mirror is None or mirror.parity > 0 else 0.0
        made = made + linear * (even + (a * kept) @ b.T)
        return made + quadratic * even * (a**2 @ (b**2).T)

    def _parts(self, theta: Tensor, a: Tensor, b: Tensor) -> Tensor:
        squared = (a[:, None] - b[None]) ** 2
        whole = (-0.5 * squared @ torch.exp(-2 * theta[: self.d])).exp() * theta[self.d].exp()
        scaled = squared[..., self.places] * torch.exp(-2 * theta[self.inner : -1])
        share, at = theta[-1].exp() / len(self.groups), 0
        for group in self.groups:
            whole = whole + share * (-0.5 * scaled[..., at : at + len(group)].sum(-1)).exp()
            at += len(group)
        return whole

    def loss(self, theta: Tensor) -> Tensor:
        y = self.case.y
        k = self.k(theta, self.case.x, self.case.x)
        k = k + theta[self.inner - 1].exp() * torch.eye(len(y), dtype=k.dtype)
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

    def found(self) -> tuple[float, dict[str, float]]:
        """The log evidence at the optimum, and the scores there; from the process as it is and from the prior."""
        more = self.prior[self.inner :, 0].numpy()
        starts = [np.concatenate([self.plain.theta(self.case.hyper), more])]
        starts.append(np.concatenate([self.plain.default_start, more]))
        value, best = min((_minimum(self, start) for start in starts), key=lambda pair: pair[0])
        theta, case = torch.from_numpy(best), self.case
        noise = float(theta[self.inner - 1].exp())
        k = self.k(theta, case.x, case.x) + noise * torch.eye(len(case.y), dtype=torch.float64)
        factor = torch.linalg.cholesky(k)
        across = self.k(theta, case.x, case.unseen)
        white = torch.linalg.solve_triangular(factor, torch.cat([case.y[:, None], across], 1), upper=False)
        mean = white[:, 1:].T @ white[:, 0]
        prior = torch.cat([self.k(theta, z[None], z[None])[0] for z in case.unseen])
        variance = (prior - white[:, 1:].square().sum(0)).clamp_min(0) + noise
        return -value, case.scores(mean, variance)


def _ratios(z: Tensor) -> Tensor:
    """Each input, from the lower end of its range, through each input plus a tenth of its range (n, d^2)."""
    above = (z / 12**0.5 + 0.5).clamp_min(0)
    return (above[:, :, None] / (above[:, None] + 0.1)).flatten(1)


FEATURES: dict[str, Callable[[Tensor], Tensor]] = {
    "tanh": lambda z: (2 * z).tanh(),
    "z/(1+|z|)": lambda z: z / (1 + z.abs()),
    "|z|": lambda z: z.abs(),
    "products": lambda z: torch.stack([z[:, i] * z[:, j] for i in range(z.shape[1]) for j in range(i)], 1),
    "ratios": _ratios,
}


def structures(case: Case, posterior: Posterior, score: float, names: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Rows of fewer inputs and of the named structures of one output."""
    d = case.x.shape[1]
    yield {"structure": AS_IT_IS, "gain": 0.0, **case.judged(case.hyper)}
    yield from fewer(case, posterior)
    state = [[j for j in range(d) if bool(case.action[j]) == of_action] for of_action in (False, True)]
    for name, groups in zip(SUMS, ([[j] for j in range(d)], state), strict=True):
        if name in names and all(groups):
            evidence, scores = Sum(case, groups).found()
            yield {"structure": name, "gain": evidence - score, "chosen": evidence - score > CHOSEN, **scores}
    for name, more in FEATURES.items():
        if (name in PAIRS and not 2 <= d <= MOST_FOR_PAIRS) or (name == "ratios" and case.mirror is not None):
            continue
        if name in names:
            wider = case.further(more)
            found = wider.fitted()
            row = wider.judged(found.posterior.hyper)
            yield {"structure": name, "gain": found.score - score, "chosen": found.score - score > CHOSEN, **row}


def _steps(original: Any, q: Tensor, u: Tensor) -> Samples:
    """One real step from each of q (n, C) under u (n, F)."""
    steps = [original.step_from(*point) for point in zip(q.numpy(), u.numpy(), strict=True)]
    arrays = [
        np.array([np.asarray(getattr(s, name), dtype=np.float64) for s in steps])
        for name in ("coordinates", "action", "next_coordinates", "reward")
    ]
    return Samples(*map(torch.from_numpy, arrays), torch.tensor([bool(s.terminated) for s in steps]))


def case_of(
    definition: EnvironmentDefinition, output: OutputModel, column: int, samples: Samples
) -> tuple[Case, float] | None:
    """The case of an output of a model, and the log evidence of its process; None if nothing is to be learned."""
    if output.posterior is None:
        return None
    chosen, posterior, lead = output.feature_map, output.posterior, leading(definition)
    if output.name == REWARD:
        used, target = ~samples.terminated, samples.reward
        q = samples.q_next if chosen.after else samples.q
    else:
        q, target = samples.q, increments(definition, samples)[:, column]
        used = usable(definition, column, samples.q_next, chosen, past_limits=output.past_limits)
    x = encode(definition, chosen, q, samples.u, samples.q_next[:, lead])[used]
    target, deviation = target[used], float(target[used].std(correction=0))
    if len(target) < UNSEEN // 10 or deviation < 1e-9:
        return None
    mirror = reflection(definition, chosen)
    options = FitOptions(quadratic=output.name == REWARD)
    objective = _Objective(posterior.x, posterior.y, options, mirror)
    value, theta = _minimum(objective, objective.theta(posterior.hyper))
    entries = torch.tensor([f.entry for f in features(definition, chosen)])
    given = torch.tensor([f.function in ("affine", "equal", "grown") for f in features(definition, chosen)])
    made = Case(
        posterior.x,
        posterior.y,
        x,
        output.standardised(target, x),
        output.scale * output.amplitude(x) / deviation,
        options,
        mirror,
        given & (entries >= len(definition.coordinates)),
        torch.tensor([f.function not in ("lead", "grown") for f in features(definition, chosen)]),
        objective.hyper(theta),
    )
    return made, -value


def rows_of(name: str, sizes: Sequence[int], seeds: Sequence[int], names: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Rows of every output of a task."""
    original = _tasks()[name]()
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
            for column, output in enumerate(model.outputs):
                found = case_of(definition, output, column, unseen)
                if found is None:
                    continue
                where = {"task": name, "n": size, "seed": seed, "output": output.name, "map": str(output.feature_map)}
                shown = {**where, "inputs": found[0].x.shape[1], "left_out": output.posterior.left_out.error}
                try:
                    yield from ({**shown, **row} for row in structures(found[0], output.posterior, found[1], names))
                except NumericalFailure:
                    continue


def designed(name: str, seed: int, drop: bool) -> dict[str, Any]:
    """An adaptive design without a policy, with the rule or without it."""
    original = _tasks()[name]()
    model = {"name": "gaussian_process", "settings": {"drop_inputs": drop}}
    design = Design.model_validate({"seed": seed, "model": model})
    definition = definition_from_spec(original.spec().model_copy(update={"design": design, "reward": Reward()}))
    unseen = _steps(original, *random_points(definition, UNSEEN, np.random.default_rng(UNSEEN_SEED)))
    samples, state = _steps(original, *initial_design(definition, BUDGET)), DesignState()
    nothing = Points(samples.q[:0], samples.u[:0])
    while len((made := advance(definition, samples, state, Request(BUDGET, 0.999, nothing))).q):
        samples, state = join(samples, _steps(original, made.q, made.u)), made.state
    off = made.model.transition(unseen.q, unseen.u).q_next - unseen.q_next
    off[:, definition.angles] = wrap(off[:, definition.angles])
    error = float((off[:, definition.moving] / increments(definition, unseen).std(0)).square().mean().sqrt())
    return {"task": name, "seed": seed, "fewer": drop, "real steps": len(samples), "error": error}


def table(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """A line for each structure and number of samples."""
    lines = []
    where = ("task", "n", "seed", "output")
    before = {tuple(r[k] for k in where): r for r in rows if r["structure"] == AS_IT_IS}
    for structure in dict.fromkeys(r["structure"] for r in rows if r["structure"] != AS_IT_IS):
        for n in sorted({r["n"] for r in rows}):
            every = [r for r in rows if (r["structure"], r["n"]) == (structure, n)]
            pairs = [(r, before[tuple(r[k] for k in where)]) for r in every if r["chosen"]]
            line = f"| {structure} | {n} | {len(pairs)} of {len(every)} |"
            if pairs:
                ratio = math.exp(np.mean([math.log((r["error"] + 1e-3) / (b["error"] + 1e-3)) for r, b in pairs]))
                grown = np.array([r["density"] - b["density"] for r, b in pairs])
                old, new = (np.mean([pair[i]["coverage"] for pair in pairs]) for i in (1, 0))
                line += f" {ratio:.2f} | {grown.mean():+.2f} | {(grown > 0.1).sum()}, {(grown < -0.1).sum()} |"
                line += f" {100 * old:.0f} %, {100 * new:.0f} % |"
            lines.append(line)
    return lines


def main() -> None:
    made = parser(__doc__)
    made.add_argument("--tasks", nargs="+", choices=_tasks(), default=list(_tasks()))
    made.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    made.add_argument("--sizes", type=int, nargs="+", default=list(SIZES))
    names = [*SUMS, *FEATURES]
    made.add_argument("--structures", nargs="+", choices=names, default=names, help="beside fewer inputs")
    made.add_argument("--fewer", action="store_true", help="fewer inputs alone, no other structure")
    made.add_argument("--designs", action="store_true", help="adaptive designs instead of hypercubes")
    options = started(made)
    if options.designs:
        found = []
        for task, seed, drop in product(options.tasks, options.seeds, (True, False)):
            found.append(designed(task, seed, drop))
            print(found[-1])
        write(options.out, "structure-designs", {"rows": found})
        return
    every = []
    for task in options.tasks:
        begun = time.perf_counter()
        rows = list(rows_of(task, options.sizes, options.seeds, [] if options.fewer else options.structures))
        every += rows
        write(options.out, f"structure-{task}", {"rows": rows})
        print(f"{task}: {len(rows)} rows, {time.perf_counter() - begun:.0f} s")
    print("\n".join(table(every)))


if __name__ == "__main__":
    main()
