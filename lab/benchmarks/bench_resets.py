"""Real steps of environments that can only be reset: designs within a budget, and returns of planners on their models.

Each run makes a design by resets alone, with the budget of its task, and no earlier data. A planner acts on the model
that it ends with (``surrogym train --algorithm planner``), in 100 real episodes, from which nothing is learned. Prints
one line for each run and appends it to ``resets.csv``. With ``--rounds``, a line for each round of the design instead,
with the returns of ten real episodes: a curve.

    python lab/benchmarks/bench_resets.py --seeds 9903 9904 9905 9906 9907 --tasks pendulum cartpole
"""

from __future__ import annotations

import argparse
import csv
import json
import time
from pathlib import Path

import gymnasium
import numpy as np
from common import OUT
from numpy.typing import NDArray

import surrogym
from surrogym.demo.tasks import TASKS
from surrogym_sampler import original
from surrogym_server.local import LocalSurrogate

# largest number of real steps of a design, by task
BUDGETS = {
    "pendulum": 18,
    "cartpole": 26,
    "mountaincar": 200,
    "swingup": 100,
    "swingup-narrow": 120,
    "acrobot": 120,
    "invertedpendulum": 30,
}
FIRST_EPISODE = 10_000  # reset seed of the first real episode
HORIZON = 20


def main() -> None:
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--tasks", nargs="+", default=tuple(BUDGETS), choices=tuple(BUDGETS))
    made.add_argument("--seeds", nargs="+", type=int, required=True)
    made.add_argument("--episodes", type=int, default=100)
    made.add_argument("--budget", type=int, help="largest number of real steps, instead of the task's")
    made.add_argument("--rounds", action="store_true", help="returns after each round of a design")
    made.add_argument("--out", type=Path, default=OUT)
    options = made.parse_args()
    for task in options.tasks:
        for seed in options.seeds:
            for row in _run(task, seed, options.budget or BUDGETS[task], options.episodes, rounds=options.rounds):
                print(json.dumps(row), flush=True)
                _append(options.out / "resets.csv", row)


def _run(task: str, seed: int, budget: int, episodes: int, *, rounds: bool) -> list[dict[str, object]]:
    environment, begun = TASKS[task].environment, time.process_time()
    machine = original.make(environment, access="reset", seed=seed, budget=budget)
    design, starts, rows = surrogym.Design(machine.spec()), np.random.default_rng(seed), []
    resets, known = 0, 0

    def row(count: int) -> dict[str, object]:
        taken = time.process_time() - begun
        returns = _returns(environment, design.surrogate(), seed, count)
        facts = {"task": task, "seed": seed, "steps": design.steps, "resets": resets, "phase": design.phase}
        earned = {"mean": round(float(returns.mean()), 2), "least": round(float(returns.min()), 2)}
        index = round(design.fidelity["confidence_index"], 4)
        return facts | {"confidence_index": index} | earned | {"episodes": count, "cpu_seconds": round(taken, 1)}

    while (query := design.ask()) is not None:
        if rounds and design.fidelity and design.steps > known:
            known = design.steps
            rows.append(row(10))
        resets += 1
        machine.begin(int(starts.integers(2**31)))
        steps = []
        for action in query.actions:
            steps.append(machine.act(np.array(action)))
            if steps[-1].terminated or steps[-1].truncated:
                break
        design.tell(query, steps)
    machine.close()
    return [*rows, row(10 if rounds else episodes)]


def _returns(environment: str, surrogate: LocalSurrogate, seed: int, episodes: int) -> NDArray[np.float64]:
    """Return the returns (episodes,) of a planner in the original environment."""
    planner, env, returns = surrogate.planner(HORIZON, seed), gymnasium.make(environment), np.zeros(episodes)
    for episode in range(episodes):
        observation, ended = env.reset(seed=FIRST_EPISODE + episode)[0], False
        while not ended:
            action = planner(np.asarray(observation, dtype=np.float64)[None])[0]
            observation, reward, terminated, truncated, _ = env.step(action)
            returns[episode] += float(reward)
            ended = terminated or truncated
    env.close()
    return returns


def _append(path: Path, row: dict[str, object]) -> None:
    new = not path.exists()
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(row))
        if new:
            writer.writeheader()
        writer.writerow(row)


if __name__ == "__main__":
    main()
