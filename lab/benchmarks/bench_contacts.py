"""Simulators with contacts: calibrated on random real steps, and then stepped themselves instead of a model of them.

    python lab/benchmarks/bench_contacts.py --tasks Swimmer-v5 Hopper-v5 HalfCheetah-v5 Pusher-v5 --seeds 10 11

For each seed, all masses, damping, friction and gears of the plant are the simulator's, times factors drawn evenly from
0.7 to 1.3. The plant takes ``--steps`` random steps from resets, on which the simulator is calibrated. A row has its
errors (of the standard deviation of the changes) before and after, on those steps and on as many others, the
largest relative error of a parameter that the steps determine, and the number of 90 % intervals with the true value.
With ``--virtual N``, a policy is trained in N steps of the calibrated simulator, and in as many of the simulator as it
is, and the mean real returns of 20 episodes are printed.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from bench_priors import scaled

from surrogym.prior import SteppedModel
from surrogym_sampler import original
from surrogym_sampler.original.describing import describe
from surrogym_sampler.original.episodes import open_episode
from surrogym_sampler.priors.calibration import RealTransitions, adjustable, calibrate, read_parameters
from surrogym_server.convert import definition_from_spec
from surrogym_server.local import LocalSurrogate
from surrogym_shared.spec import EnvironmentSpec, Inequality, Term
from surrogym_trainer.evaluation.evaluator import EvaluationSettings, evaluate
from surrogym_trainer.policies import load_policy
from surrogym_trainer.training import TrainSettings, settings, train

OFF = 0.3
TASKS = ("Swimmer-v5", "Hopper-v5", "HalfCheetah-v5", "Pusher-v5")
HOPPER = (("rootz", "<=", 0.7), ("rooty", ">=", 0.2), ("rooty", "<=", -0.2))  # ends of an episode of Gymnasium's


def main() -> None:
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--tasks", nargs="+", default=TASKS, choices=TASKS)
    made.add_argument("--seeds", nargs="+", type=int, required=True)
    made.add_argument("--steps", type=int, default=100, help="real steps for the calibration")
    made.add_argument("--virtual", type=int, default=0, help="steps of the simulator for each policy")
    options = made.parse_args()
    torch.set_num_threads(1)
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    for task in options.tasks:
        spec = specification(task)
        for seed in options.seeds:
            run(task, spec, seed, options.steps, options.virtual)


def specification(task: str) -> EnvironmentSpec:
    spec = describe(task).spec
    if task != "Hopper-v5":
        return spec
    ends = [(Inequality(term=Term.linear(**{one: 1}), relation=than, value=at),) for one, than, at in HOPPER]
    return EnvironmentSpec.model_validate(
        {**spec.model_dump(), "termination": [[e.model_dump() for e in g] for g in ends]}
    )


def run(task: str, spec: EnvironmentSpec, seed: int, count: int, virtual: int) -> None:
    rng = np.random.default_rng([seed, 58])
    simulator: Any = original.make(task, spec=spec)
    names = tuple(adjustable(simulator).parameters())
    factors = rng.uniform(1 - OFF, 1 + OFF, len(names))

    def plant() -> Any:
        return scaled(original.make(task, spec=spec), names, factors)

    truth, begun = adjustable(plant()).parameters(), time.process_time()
    real, other = (taken(plant(), rng, count) for _ in range(2))
    own = adjustable(simulator)

    def step(values: Any, q: Any, u: Any) -> Any:
        own.set_parameters(dict(zip(names, values.tolist(), strict=True)))
        return simulator.step_from(q, u).next_coordinates

    before = np.array([own.parameters()[name] for name in names])
    found = calibrate(spec, real, read_parameters(names, own), before, step)
    values = np.array([found.values[name] for name in names])
    held = [calibrate(spec, other, (), at, step).error for at in (before, values)]
    known = [one for one in found.parameters if one.determined]
    wrong = max((abs(one.value / truth[one.name] - 1) for one in known), default=float("nan"))
    inside = sum(one.low <= truth[one.name] <= one.high for one in found.parameters)
    print(
        f"{task} {seed}: {count} real steps, error {found.error_before:.3g} -> {found.error:.2g}, on others "
        f"{held[0]:.3g} -> {held[1]:.2g}; {len(known)} of {len(names)} parameters determined, within {wrong:.2g}; "
        f"{inside} intervals with the true value; {time.process_time() - begun:.0f} s"
    )
    for words, at in (("calibrated", values), ("as it is", before)) if virtual else ():
        begun = time.process_time()
        own.set_parameters(dict(zip(names, at.tolist(), strict=True)))
        earned = returns(
            LocalSurrogate(spec, SteppedModel(definition_from_spec(spec), simulator)), plant, virtual, seed
        )
        print(f"{task} {seed}: {virtual} steps of the simulator {words}: {earned}; {time.process_time() - begun:.0f} s")


def taken(plant: Any, rng: np.random.Generator, count: int) -> RealTransitions:
    """Random steps from resets; each action is held for one to four steps."""
    steps, low, high = [], plant.spec().action.low, plant.spec().action.high
    plant.begin(int(rng.integers(2**31)))
    while len(steps) < count:
        action = rng.uniform(low, high)
        for _ in range(rng.integers(1, 5)):
            steps.append(plant.act(action))
            if steps[-1].terminated:
                plant.begin(int(rng.integers(2**31)))
                break
    columns = ("coordinates", "action", "next_coordinates")
    return RealTransitions(*(np.array([getattr(step, name) for step in steps[:count]]) for name in columns))


def returns(model: LocalSurrogate, plant: Callable[[], Any], virtual: int, seed: int) -> str:
    settings.CHECKS, settings.CHECK_EPISODES = 4, 4
    with TemporaryDirectory() as folder:
        path = Path(folder) / "policy.zip"
        train(model, path, TrainSettings("FASTPPO", virtual, num_envs=16, seed=seed, start_box=0.0, prolong=False))
        predict = load_policy(path, "FASTPPO")
    made = open_episode("", plant().spec(), lambda: plant())
    found = evaluate(predict, lambda: made, EvaluationSettings(20, parallel=1))
    return f"{np.mean(found.returns):.1f} (least {np.min(found.returns):.1f})"


if __name__ == "__main__":
    main()
