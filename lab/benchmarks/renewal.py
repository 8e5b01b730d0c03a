"""What a changed plant costs to learn again if the old model is the prior of the new one.

    python lab/benchmarks/renewal.py --first-seed 514 --seeds 5

Each plant (``support.levitation``: a levitated ball, a pendulum, two tanks) is learned, and then changes: the ball and
the pendulum are 30 % heavier, the pump is 20 % weaker. Any state can be set. A row has the real steps of a fresh design
in the changed plant, and real returns there, means of 200 episodes:

- old: of the policy of the plant before its change;
- fresh: of a policy trained in the fresh model;
- renewed: of a policy trained in a model whose prior is the old one, with a quarter of the fresh design's real steps;
- tuned: of a policy trained in the same model, beginning with the old policy's network.

``renewed_steps`` and ``tuned_steps`` are the virtual steps of the last two trainings, and ``renewed_reached`` and
``tuned_reached`` those of them after which the imagined return had 95 % of the gain over no action that the better one
of the two has at last; -1 if it never had. ``share`` is how much of the fresh policy's gain over no action the renewed
one has.

Rows are saved in ``--out``/renewal.csv, so that the same command continues after Ctrl-C.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import numpy as np
import torch
from common import OUT

import surrogym
from support.levitation import LEVITATION, PENDULUM, TANKS, Plant, real_returns
from surrogym_lab.reproduce.rows import read_records, write_records
from surrogym_trainer.policies import load_policy
from surrogym_trainer.training import TrainProgress, TrainSettings, train

CHANGES = {
    "levitation": (LEVITATION, {"mass": 1.3}),
    "pendulum": (PENDULUM, {"mass": 1.3}),
    "tanks": (TANKS, {"pump": 0.8}),
}
EPISODES = 200
SEARCH = "FASTPPO"
ENOUGH = 0.95  # of the gain, up to which a training counts as having reached it
FEWEST = 4  # real steps of a renewal


@dataclass(frozen=True)
class Row:
    """One change of one plant."""

    plant: str
    seed: int
    steps: int  # real steps of the fresh design
    renewal: int  # real steps of the renewal
    idle: float  # mean return of no action
    old: float
    fresh: float
    renewed: float
    tuned: float
    renewed_steps: int
    tuned_steps: int
    renewed_reached: int
    tuned_reached: int

    @property
    def share(self) -> float:
        """Share of the fresh policy's gain over no action."""
        return (self.renewed - self.idle) / (self.fresh - self.idle)


def main() -> None:
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--plants", nargs="+", choices=list(CHANGES), default=list(CHANGES))
    made.add_argument("--first-seed", type=int, default=0)
    made.add_argument("--seeds", type=int, default=1)
    made.add_argument("--out", type=Path, default=OUT)
    options = made.parse_args()
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    torch.set_num_threads(1)
    path: Path = options.out / "renewal.csv"
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = read_records(path, Row)
    done = {(row.plant, row.seed) for row in rows}
    for seed in range(options.first_seed, options.first_seed + options.seeds):
        for plant in options.plants:
            if (plant, seed) not in done:
                rows.append(run(plant, seed))
                write_records(path, Row, rows)
                print(rows[-1], f"share {rows[-1].share:.3f}")


def run(plant: str, seed: int) -> Row:
    machine, change = CHANGES[plant]
    changed = {**machine.real, **change}

    def value(acts: Any) -> float:
        return float(real_returns(machine, changed, acts, EPISODES, seed)[0].mean())

    old = design(machine, machine.real, seed, machine.budget)
    fresh = design(machine, changed, seed + 1_000, machine.budget)
    budget = max(FEWEST, fresh.steps // 4)
    renewed = design(machine, changed, seed + 1_000, budget, old.to_file())
    idle = value(lambda shown: np.zeros((len(shown), machine.actions)))
    with TemporaryDirectory() as folder:
        trained = [policy(one, seed, Path(folder) / f"{i}.zip") for i, one in enumerate((old, fresh, renewed))]
        trained.append(policy(renewed, seed, Path(folder) / "tuned.zip", trained[0].path))
        earned = [value(load_policy(one.path, SEARCH)) for one in trained]
    aim = idle + ENOUGH * (max(one.curve[-1][1] for one in trained[2:]) - idle)
    steps = [one.curve[-1][0] for one in trained[2:]]
    reached = [next((at for at, found in one.curve if found >= aim), -1) for one in trained[2:]]
    return Row(
        *(plant, seed, fresh.steps, renewed.steps, idle),
        *(earned[0], earned[1], earned[2], earned[3]),
        *(steps[0], steps[1], reached[0], reached[1]),
    )


def design(machine: Any, parameters: Mapping[str, float], seed: int, budget: int, prior: Any = None) -> surrogym.Design:
    """Learn a plant, from a prior if one is given."""
    chosen = machine.spec.design.model_copy(update={"seed": seed, "budget": budget})
    plant = Plant(machine, parameters, np.random.default_rng(seed))
    made = surrogym.Design(machine.spec.model_copy(update={"design": chosen}), prior=prior, threads=1)
    while (query := made.ask()) is not None:
        made.tell(query, [plant.step_from(np.array(query.coordinates), np.array(query.action))])
    return made


class Trained(NamedTuple):
    """A trained policy."""

    path: Path
    curve: list[tuple[int, float]]  # virtual steps so far, best imagined return so far


def policy(learned: surrogym.Design, seed: int, path: Path, start: Path | None = None) -> Trained:
    """Train a policy in a model, from the network of another policy if one is given."""
    curve: list[tuple[int, float]] = []

    def record(now: TrainProgress) -> None:
        if now.imagined_return is not None:
            curve.append((now.steps, max(now.imagined_return, curve[-1][1] if curve else -np.inf)))

    train(learned.surrogate(), path, TrainSettings(algorithm=SEARCH, seed=seed, start_from=start), record)
    return Trained(path, curve)


if __name__ == "__main__":
    main()
