"""Whether evidence can choose which inputs an output reads, sums of functions of few inputs, or further features.

python lab/benchmarks/bench_structure.py --fewer --seeds 106 107 108
python lab/benchmarks/bench_structure.py --seeds 100 --sizes 10 20 40
python lab/benchmarks/bench_structure.py --seeds 100 101 --sizes 10 20 40 --structures ratios
python lab/benchmarks/bench_structure.py --designs --tasks chain rooms --seeds 110 111 112

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
from collections.abc import Callable, Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import numpy as np
import torch
from common import parser, started, write
from machines import Chain, Rooms
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
    table,
    unseen_steps,
)
from torch import Tensor

from support.fermenter import Fermenter
from support.models import gaussian_processes
from support.reactor import example
from surrogym.demo.tasks import TASKS as DEMOS
from surrogym_sampler.original import make
from surrogym_server.errors import NumericalFailure
from surrogym_server.gp import condition
from surrogym_server.gp.posterior import Posterior
from surrogym_server.gp.search import minimum
from surrogym_server.gp.selection import select_inputs
from surrogym_server.models.gaussian_process.learning.dropping import FEWEST, LESS, ODDS, WIN
from surrogym_server.models.gaussian_process.learning.output_learner import EXPLAINED

SIZES = (10, 20, 40, 100)
SUMS = ("additive", "state + action")
PAIRS, MOST_FOR_PAIRS = ("products", "ratios"), 8  # inputs; more have too many pairs


def _tasks() -> dict[str, Callable[[], Any]]:
    tasks: dict[str, Callable[[], Any]] = {
        name: (lambda task=task: make(task.environment)) for name, task in DEMOS.items()
    }
    return tasks | {"reactor": example().Reactor, "fermenter": Fermenter, "chain": Chain, "rooms": Rooms}


def fewer(case: Case, posterior: Posterior) -> Iterator[dict[str, Any]]:
    """Backward elimination: by evidence alone, and as it is built."""
    found = select_inputs(posterior, case.options, case.may, ODDS)
    left, less = found.mask.nonzero()[:, 0].tolist(), case.only(found.mask)
    row = {"left": left, "gain": found.gain, "chosen": len(left) < len(found.mask)} | less.judged(found.hyper)
    yield {"structure": "fewer inputs, by evidence", **row}
    before, after = (made.left_out.error for made in (posterior, condition(found.hyper, less.x, less.y)))
    wins = found.gain > WIN * len(case.y) and len(case.y) >= FEWEST and before > EXPLAINED and after <= LESS * before
    wins = wins and not case.options.quadratic  # the reward keeps all inputs
    yield {"structure": "fewer inputs, as built", **row, "chosen": row["chosen"] and wins}


class Sum(Composite):
    """The process as it is plus squared exponentials of groups of inputs. The groups share one variance, and have
    length scales of their own. Each group counts equally."""

    def __init__(self, case: Case, groups: Sequence[Sequence[int]]) -> None:
        self.groups = [list(group) for group in groups if len(group)]
        self.places = [j for group in self.groups for j in group]
        own = [(math.log(2.0) + 0.5 * math.log(len(group)), 1.2) for group in self.groups for _ in group]
        lower = np.concatenate([np.full(len(own), math.log(0.02)), [math.log(1e-8)]])
        upper = np.concatenate([np.full(len(own), math.log(1e3)), [math.log(1e4)]])
        super().__init__(case, [*own, (-2.0, 2.0)], lower, upper)

    def k(self, theta: Tensor, a: Tensor, b: Tensor) -> Tensor:
        made = self._parts(theta, a, b)
        mirror = self.case.mirror
        if mirror is not None:
            made = made + mirror.parity * self._parts(theta, a, b * mirror.signs)
        return made + self.polynomial(theta, a, b)

    def _parts(self, theta: Tensor, a: Tensor, b: Tensor) -> Tensor:
        squared = (a[:, None] - b[None]) ** 2
        whole = (-0.5 * squared @ torch.exp(-2 * theta[: self.d])).exp() * theta[self.d].exp()
        scaled = squared[..., self.places] * torch.exp(-2 * theta[self.inner : -1])
        share, at = theta[-1].exp() / len(self.groups), 0
        for group in self.groups:
            whole = whole + share * (-0.5 * scaled[..., at : at + len(group)].sum(-1)).exp()
            at += len(group)
        return whole

    def found(self) -> tuple[float, dict[str, float]]:
        """The log evidence at the optimum, and the scores there; from the process as it is and from the prior."""
        starts = [self.start(), np.concatenate([self.plain.default_start, self.start()[self.inner :]])]
        value, theta = min((minimum(self, start) for start in starts), key=lambda pair: pair[0])
        return -value, self.scores(theta)


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


def rows_of(name: str, sizes: Sequence[int], seeds: Sequence[int], names: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Rows of every output of a task."""
    original = _tasks()[name]()
    definition = definition_of(original, SETTINGS)
    unseen = unseen_steps(original, definition)
    for size in sizes:
        for seed in seeds:
            learned = hypercube(original, definition, size, seed)
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
            row = designed(_tasks()[task](), seed, {"drop_inputs": drop})
            found.append({"task": task, "seed": seed, "fewer": drop, **row})
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
