"""Real steps until a design is ready, by the default acquisition and by those of other papers: BARL, TIP and OPAX.

A design of each task, acquisition and seed runs to its end, as a server would run it. No policy is trained, so no query
is near the states of one. A task ``NAME:resets`` can only be reset, and each query is a rollout. ``seconds`` is the
time of all rounds, fits included.

A design is ready when its model is sure of the whole sampling range. BARL and TIP do not aim at that, but at the
optimal trajectory, and this comparison does not show what their models know there.

Run it by::

    python tests/benchmarks/bench_trajectories.py --seeds 5 --first-seed 3200
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from itertools import product
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
import torch

from support.real_steps import join, samples_of
from surrogym_client.experiments.tasks import EVERY_TASK
from surrogym_client.original import make
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.points import Points
from surrogym_server.environment.samples import Samples
from surrogym_server.sampling.design import DesignState, Request, advance, initial_design, initial_rollouts
from surrogym_shared.spec import EnvironmentSpec

TASKS = ("pendulum", "pendulum:resets", "cartpole:resets", "swingup")
ACQUISITIONS = ("integrated_variance", "barl", "tip", "opax")
BUDGET = {"pendulum": 40, "cartpole": 40, "swingup": 60}
LONGEST = 40  # actions of one rollout


@dataclass(frozen=True)
class Row:
    task: str
    acquisition: str
    seed: int
    verdict: str
    steps: int
    rounds: int
    seconds: float


class Machine:
    """An original environment, its specification with one acquisition and seed, and what it answers."""

    def __init__(self, task: str, acquisition: str, seed: int) -> None:
        name, _, resets = task.partition(":")
        self._original, self._seed = make(EVERY_TASK[name].environment), 1_000 * seed
        spec = self._original.spec()
        chosen = {"acquisition": acquisition, "seed": seed, "budget": BUDGET[name]}
        changes = {"design": spec.design.model_dump() | chosen}
        only = {"query": "rollout", "max_rollout": LONGEST} if resets else {}
        self.spec = EnvironmentSpec.model_validate(spec.model_dump() | changes | only)
        self.budget = BUDGET[name]

    def answer(self, q: torch.Tensor, u: torch.Tensor) -> Samples:
        return samples_of([self._original.step_from(*point) for point in zip(q.numpy(), u.numpy(), strict=True)])

    def roll(self, actions: torch.Tensor) -> Samples:
        """The real steps of one action sequence (T, F) from a reset of its own, up to the end of the episode."""
        self._seed += 1
        self._original.begin(self._seed)
        steps = []
        for action in actions.numpy():
            steps.append(self._original.act(action))
            if steps[-1].terminated:
                break
        return samples_of(steps)


def designed(task: str, acquisition: str, seed: int) -> Row:
    """Run one design to its end."""
    machine, started = Machine(task, acquisition, seed), time.perf_counter()
    definition = definition_from_spec(machine.spec)
    if definition.max_rollout is None:
        samples = machine.answer(*initial_design(definition, machine.budget))
    else:
        samples = join(*map(machine.roll, initial_rollouts(definition, machine.budget)))
    state, nothing = DesignState(), Points(samples.q[:0], samples.u[:0])
    while True:
        made = advance(definition, samples, state, Request(machine.budget, machine.spec.design.target, nothing))
        state = made.state
        if made.rollouts:
            samples = join(samples, *(machine.roll(rollout.actions) for rollout in made.rollouts))
        elif len(made.q):
            samples = join(samples, machine.answer(made.q, made.u))
        else:
            took = round(time.perf_counter() - started, 1)
            return Row(task, acquisition, seed, made.verdict, len(samples), state.round, took)


def table(rows: Sequence[Row]) -> str:
    """Designs that were ready, real steps and seconds: median and range over the seeds."""
    lines = ["| task | acquisition | ready | real steps | seconds |", "|---|---|---|---|---|"]
    for task, acquisition in dict.fromkeys((row.task, row.acquisition) for row in rows):
        cell = [row for row in rows if (row.task, row.acquisition) == (task, acquisition)]
        ready = sum(row.verdict == "ready" for row in cell)
        steps, seconds = (_spread([getattr(row, name) for row in cell]) for name in ("steps", "seconds"))
        lines.append(f"| {task} | `{acquisition}` | {ready} of {len(cell)} | {steps} | {seconds} |")
    return "\n".join(lines) + "\n"


def _spread(values: Sequence[float]) -> str:
    return f"{np.median(values):.0f} ({min(values):.0f} to {max(values):.0f})"


def main() -> None:
    options = _options()
    options.out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    rows: list[Row] = []
    with (options.out / "rows.csv").open("w", encoding="utf-8", newline="") as lines:
        writer = csv.DictWriter(lines, [field.name for field in fields(Row)])
        writer.writeheader()
        seeds = range(options.first_seed, options.first_seed + options.seeds)
        for task, seed, acquisition in product(options.tasks, seeds, options.acquisitions):
            if acquisition == "tip" and ":" not in task:
                continue  # of single queries TIP and BARL think the same
            rows.append(designed(task, acquisition, seed))
            writer.writerow(asdict(rows[-1]))
            lines.flush()
            print(rows[-1], flush=True)
    (options.out / "trajectories.md").write_text(table(rows), encoding="utf-8")
    print(table(rows))


def _options() -> argparse.Namespace:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--tasks", nargs="+", default=TASKS, choices=TASKS)
    options.add_argument("--acquisitions", nargs="+", default=ACQUISITIONS)
    options.add_argument("--seeds", type=int, default=5)
    options.add_argument("--first-seed", type=int, default=3200, help="seeds from 3000 are for tuning")
    options.add_argument("--out", type=Path, default=Path("runs/trajectories"))
    return options.parse_args()


if __name__ == "__main__":
    main()
