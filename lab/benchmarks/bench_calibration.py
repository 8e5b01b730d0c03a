"""Coverage and interval score of predictions one and ten steps ahead, of designs that were stopped early: with one
optimum of the hyperparameters, and with hyperparameters that are uncertain.

Run by ``make bench ARGS="--parts calibration"``; rows of every design go into the JSON file.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import numpy as np
import torch
from acquisition import designed
from common import parser, started, write

from support.calibration import Calibration, Trajectories, mean, one_step, ten_steps, trajectories
from surrogym_sampler.original import make
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.sampling.tolerances import default_tolerances
from surrogym_shared.spec import Design

TASKS = {
    "pendulum": "Pendulum-v1",
    "cartpole": "CartPole-v1",
    "mountaincar": "MountainCarContinuous-v0",
    "swingup": "surrogym/CartPoleSwingUp-v0",
    "acrobot": "Acrobot-v1",
}
SAMPLES = (5, 8, 12, 20)  # default
DRAWS, TRAJECTORIES, TRAJECTORY_SEED = 64, 40, 30_000
WAYS = ("one optimum", "uncertain")
AHEAD = {"one step": one_step, "ten steps": ten_steps}


def rows_of(task: str, seed: int, real: Trajectories, counts: Sequence[int]) -> list[dict[str, Any]]:
    """One row for each number of samples, way and horizon."""
    spec = make(TASKS[task]).spec().model_copy(update={"design": Design(initial=counts[0], seed=seed)})
    found = []
    for model, samples in designed(spec, counts):
        for way in WAYS:
            for ahead in AHEAD:
                case = {"task": task, "seed": seed, "samples": samples, "way": way, "ahead": ahead}
                found.append(case | asdict(_calibration(model, way, ahead, real, seed)))
    return found


def _calibration(model: GaussianProcessModel, way: str, ahead: str, real: Trajectories, seed: int) -> Calibration:
    draws = model if way == WAYS[0] else model.uncertain_functions
    noise = torch.Generator().manual_seed(seed)
    paths = draws.draw(torch.randn(DRAWS, draws.path_size, generator=noise, dtype=torch.float64))
    drawn, truth = AHEAD[ahead](model, draws, paths, real)
    defaults = np.array(default_tolerances(model.definition, model.scales.tolist()))
    return Calibration.of(drawn, truth, defaults * (1 if ahead == "one step" else np.sqrt(10)))


def table(rows: list[dict[str, Any]]) -> str:
    """Means over tasks and seeds, a line for each number of samples."""
    lines = ["| samples | ahead | way | coverage of 50, 80, 90 % | interval score / tolerance | counted |"]
    lines.append("|---|---|---|---|---|---|")
    for samples in dict.fromkeys(row["samples"] for row in rows):
        for ahead in AHEAD:
            for way in WAYS:
                chosen = [r for r in rows if (r["samples"], r["ahead"], r["way"]) == (samples, ahead, way)]
                made = mean([Calibration(r["coverage"], r["interval_score"], r["counted"]) for r in chosen])
                shares = ", ".join(f"{100 * share:.0f}" for share in made.coverage)
                lines.append(
                    f"| {samples} | {ahead} | {way} | {shares} | {made.interval_score:.2f} | {made.counted:.2f} |"
                )
    return "\n".join(lines)


def main() -> None:
    made = parser(__doc__)
    made.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    made.add_argument("--seeds", type=int, default=5)
    made.add_argument("--first-seed", type=int, default=0)
    made.add_argument("--samples", type=int, nargs="+", default=SAMPLES, help="sizes of a design at which it is judged")
    options = started(made)
    rows: list[dict[str, Any]] = []
    for task in options.tasks:
        real = trajectories(make(TASKS[task]).spec(), TRAJECTORIES, TRAJECTORY_SEED)
        for seed in range(options.first_seed, options.first_seed + (1 if options.quick else options.seeds)):
            rows += rows_of(task, seed, real, options.samples)
        print(f"{task}\n{table([row for row in rows if row['task'] == task])}\n")
    print(f"all\n{table(rows)}")
    write(options.out, "calibration", {"rows": rows})


if __name__ == "__main__":
    main()
