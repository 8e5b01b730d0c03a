"""Real steps of environments that can only be reset: designs within a budget, and returns of planners on their models.

Each run makes a design by resets alone, with the budget of its task, and no earlier data. A planner acts on the model
that it ends with (``surrogym train --algorithm planner``), in 100 real episodes, from which nothing is learned. The
targets are those of the demo, without its second evaluation. Prints one line for each run, and appends it to
``resets.csv``. With ``--rounds`` there is a line for each round of the design, with the returns of ten real episodes.
``decision_ms`` is the median processor time of the planner's decisions.

    python lab/benchmarks/bench_resets.py --seeds 9903 9904 9905 9906 9907 --tasks pendulum cartpole
    python lab/benchmarks/bench_resets.py --seeds 121 122 123 124 125 --tasks swingup --dirt encoder --budget 150
    python lab/benchmarks/bench_resets.py --seeds 220 221 222 --tasks furuta --budget 400 --horizon 25

``--dirt`` gives the swing-up one kind of dirt, and sizes that each seed draws (``dirty_swingup.py``). A rod that is up
is judged by its own angle then, not by what is read of it. ``--acting-with`` is the dirt of the machine on which the
planner acts, if it is another one than the machine that was learned. The other tasks are the dirty machines that a
planner can steer (``bench_trials.py``), which have no target here. If such a machine has a stop, a row says how many
rollouts of the design and how many real episodes were beyond it: ``furuta-limits`` has declared limits that keep the
arm inside, ``furuta`` has none.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from bench_dirt import KINDS
from bench_trials import MACHINES, SWING_UPS, specification
from common import OUT, append_row
from dirty_swingup import InProcess
from numpy.typing import NDArray

import surrogym
from surrogym.demo.tasks import TASKS, Outcome
from surrogym_sampler import original
from surrogym_sampler.original.episodes import Episode, RolloutEpisode, open_episode
from surrogym_sampler.original.protocol import RolloutEnvironment
from surrogym_sampler.original.rollouts import answering, keeping_limits
from surrogym_shared.port import horizon_of
from surrogym_shared.spec import with_history
from surrogym_trainer.evaluation.evaluator import EvaluationSettings, evaluate

# largest number of real steps of a design, by task
BUDGETS = {
    "pendulum": 18,
    "cartpole": 26,
    "mountaincar": 200,
    "swingup": 100,
    "swingup-narrow": 120,
    "acrobot": 120,
    "invertedpendulum": 30,
    "furuta": 400,
    "furuta-limits": 400,
    "double_pendulum": 1_000,
}


def main() -> None:
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--tasks", nargs="+", default=tuple(t for t in BUDGETS if t in TASKS), choices=tuple(BUDGETS))
    made.add_argument("--seeds", nargs="+", type=int, required=True)
    made.add_argument("--episodes", type=int, default=100)
    made.add_argument("--budget", type=int, help="largest number of real steps, instead of the task's")
    made.add_argument("--dirt", default="", choices=("", *KINDS), help="kind of dirt of the swing-up")
    made.add_argument("--acting-with", choices=KINDS, help="dirt of the swing-up on which the planner acts")
    made.add_argument("--horizon", type=int, help="steps of each rollout of the planner")
    made.add_argument("--rounds", action="store_true", help="returns after each round of a design")
    made.add_argument("--out", type=Path, default=OUT)
    options = made.parse_args()
    for task in options.tasks:
        for seed in options.seeds:
            for row in _run(task, seed, options):
                print(json.dumps(row), flush=True)
                append_row(options.out / "resets.csv", row)


def _run(task: str, seed: int, options: argparse.Namespace) -> list[dict[str, object]]:
    begun, dirt, rounds, budget = time.process_time(), options.dirt, options.rounds, options.budget or BUDGETS[task]
    if task in MACHINES:
        name = MACHINES[task].name.format(seed=seed)
        machine = original.make(name, spec=specification(MACHINES[task], name, seed, budget))
    else:
        machine = original.make(TASKS[task].environment, access="reset", seed=seed, budget=budget)
    if dirt:
        spec = machine.spec()
        spec = with_history(spec, actions=SWING_UPS[dirt]) if dirt in SWING_UPS else spec
        machine = answering(InProcess(dirt, seed, spec))
    assert isinstance(machine, RolloutEnvironment)
    machine = keeping_limits(machine)
    assert isinstance(machine, RolloutEnvironment)
    design, starts, rows = surrogym.Design(machine.spec()), np.random.default_rng(seed), []
    resets, known, left = 0, 0, 0

    def row(count: int) -> dict[str, object]:
        taken = time.process_time() - begun
        earned = _earned(task, options.acting_with or dirt, design, seed, count, options.horizon)
        facts = {
            "task": f"{task} {dirt}".strip(),
            "seed": seed,
            "steps": design.steps,
            "resets": resets,
            "left": left,
            "phase": design.phase,
        }
        index = round(design.fidelity["confidence_index"], 4)
        return facts | {"confidence_index": index} | earned | {"episodes": count, "cpu_seconds": round(taken, 1)}

    while (query := design.ask()) is not None:
        if rounds and design.fidelity and design.steps > known:
            known = design.steps
            rows.append(row(10))
        resets += 1
        acting, state = design.acting(query), machine.begin(int(starts.integers(2**31)))
        steps = []
        for number in range(query.steps):
            steps.append(machine.act(np.array(acting(number, state))))
            state = np.asarray(steps[-1].next_coordinates)
            if steps[-1].terminated or steps[-1].truncated:
                break
        design.tell(query, steps)
        left += _is_beyond(task, np.array([step.next_coordinates for step in steps]))
    machine.close()
    return [*rows, row(10 if rounds else options.episodes)]


def _is_beyond(task: str, states: NDArray[np.float64]) -> bool:
    """Return whether any of the states (n, C) is beyond the stop of the task's machine, if it has one."""
    stop = MACHINES[task].stop if task in MACHINES else None
    return stop is not None and bool((np.abs(states[:, 0]) > stop).any())


def _earned(
    task: str, dirt: str, design: surrogym.Design, seed: int, episodes: int, horizon: int | None
) -> dict[str, object]:
    """Return what a planner earns in the original environment, and whether this reaches the task's target."""
    surrogate, noise = design.surrogate(), {o["name"]: o["sensor_noise"] for o in design.fidelity["outputs"]}
    spec, settings = surrogate.spec(), EvaluationSettings(episodes)
    planner = surrogate.planner(horizon or horizon_of(spec), seed, sensor_noise=noise)
    name = MACHINES[task].name.format(seed=seed) if task in MACHINES else spec.environment or task
    judged = InProcess(dirt or "clean", seed, spec)

    taken = []

    def acting(observations: NDArray[np.floating]) -> NDArray[Any]:
        begin = time.process_time()
        actions = planner(observations)
        taken.append(time.process_time() - begin)
        return actions

    def episode() -> Episode:
        dirty = answering(judged) if dirt else None
        if isinstance(dirty, RolloutEnvironment):
            return RolloutEpisode(dirty)
        return open_episode(name, spec, partial(original.make, name, spec=spec))

    real = evaluate(acting, episode, settings)
    mean, least = float(real.returns.mean()), float(real.returns.min())
    success = None if real.success is None else float(np.mean(judged.ups if dirt else real.success))
    reached = None
    if task in TASKS:
        reached = replace(TASKS[task].target, also_success=None).reached(Outcome(mean, least, success))
    return {
        "mean": round(mean, 2),
        "least": round(least, 2),
        "success": success,
        "reached": reached,
        "decision_ms": round(1e3 * statistics.median(taken), 2),
        "violations": sum(_is_beyond(task, trace.coordinates) for trace in real.traces),
        "fallback_episodes": None if real.limits is None else real.limits.fallback_episodes,
        "fallbacks": None if real.limits is None else real.limits.fallbacks,
    }


if __name__ == "__main__":
    main()
