"""Simulators with contacts: calibrated on random real steps, and then stepped themselves instead of a model of them.

    python lab/benchmarks/bench_contacts.py --tasks Swimmer-v5 Hopper-v5 HalfCheetah-v5 Pusher-v5 --seeds 10 11
    python lab/benchmarks/bench_contacts.py --tasks Swimmer-v5 Hopper-v5 HalfCheetah-v5 --seeds 14 15 --searches 3

The simulator is the task's MuJoCo file. For each seed, all masses, damping, friction and gears of the plant are the
file's, times factors drawn evenly from 0.7 to 1.3 (``--off 0.3``). The plant takes ``--steps`` random steps from
resets, on which the simulator is calibrated. A row has its errors (of the standard deviation of the changes) before
and after, the largest relative error of a parameter that the steps determine, and the number of 90 % intervals with
the true value. With ``--searches N``, N searches by CMA-ES train linear policies in the calibrated simulator, and in
the simulator as it is. The one with the best return in that simulator takes 20 real episodes, whose mean return is
printed.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import gymnasium.envs.mujoco
import numpy as np
import torch
from bench_priors import scaled

import surrogym
from surrogym_sampler import original
from surrogym_sampler.original.describing import describe
from surrogym_sampler.original.episodes import open_episode
from surrogym_sampler.original.protocol import RealStep
from surrogym_sampler.priors.calibration import adjustable
from surrogym_server.local import LocalSurrogate
from surrogym_shared.spec import DeclaredReward, EnvironmentSpec, Inequality, Quantity, RewardTerm, Term
from surrogym_trainer.evaluation.evaluator import EvaluationSettings, evaluate
from surrogym_trainer.policies import load_policy
from surrogym_trainer.training import TrainSettings, checks, train

FILES = Path(gymnasium.envs.mujoco.__file__).parent / "assets"
FILE = {
    "Swimmer-v5": "swimmer.xml",
    "Hopper-v5": "hopper.xml",
    "HalfCheetah-v5": "half_cheetah.xml",
    "Pusher-v5": "pusher_v5.xml",
}
# Declared reward of a policy search: this coordinate, less this weight times the squared actions. Hopper's 1 for each
# step is left out, because standing earns it.
REWARDS = {
    "Swimmer-v5": ("slider1_velocity", 1e-4),
    "Hopper-v5": ("rootx_velocity", 1e-3),
    "HalfCheetah-v5": ("rootx_velocity", 0.1),
}
# Settings of a search, chosen with seeds 1 to 3 and the file's own parameters: virtual steps, longest episode,
# candidates in a generation, episodes of each, and the deviation of a parameter at the start.
SEARCH = {
    "Swimmer-v5": (400_000, 1_000, 12, 1, 0.3),
    "Hopper-v5": (1_400_000, 1_000, 24, 1, 0.3),
    "HalfCheetah-v5": (3_000_000, 500, 24, 2, 0.5),
}
HOPPER = (("rootz", "<=", 0.7), ("rooty", ">=", 0.2), ("rooty", "<=", -0.2))  # ends of an episode of Gymnasium's


def main() -> None:
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--tasks", nargs="+", default=list(FILE), choices=FILE)
    made.add_argument("--seeds", nargs="+", type=int, required=True)
    made.add_argument("--steps", type=int, default=100, help="real steps for the calibration")
    made.add_argument("--searches", type=int, default=0, help="policy searches in each simulator")
    made.add_argument("--off", type=float, default=0.3, help="largest relative error of a parameter")
    made.add_argument("--arms", nargs="+", default=["calibrated", "as it is"], help="simulators of the searches")
    options = made.parse_args()
    torch.set_num_threads(1)
    checks.CHECK_EPISODES = 8
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    for task in options.tasks:
        spec = specification(task)
        for seed in options.seeds:
            run(task, spec, seed, options)


def specification(task: str) -> EnvironmentSpec:
    spec = describe(task).spec
    if task not in REWARDS:
        return spec
    name, weight = REWARDS[task]
    size = spec.action.size
    entries = tuple(Quantity(action=tuple(float(i == k) for i in range(size))) for k in range(size))
    terms = (
        RewardTerm(shape="linear", of=(Quantity(term=Term.linear(**{name: 1})),)),
        RewardTerm(weight=-weight, shape="square", of=entries),
    )
    reward = DeclaredReward(kind="declared", timing="after", terms=terms)
    ends = [[Inequality(term=Term.linear(**{one: 1}), relation=than, value=at)] for one, than, at in HOPPER]
    changed = {"reward": reward.model_dump()}
    if task == "Hopper-v5":
        changed["termination"] = [[end.model_dump() for end in group] for group in ends]
    return EnvironmentSpec.model_validate(spec.model_dump() | changed)


def run(task: str, spec: EnvironmentSpec, seed: int, options: argparse.Namespace) -> None:
    rng, begun, own = np.random.default_rng([seed, 58]), time.process_time(), describe(task).spec
    usual = adjustable(original.make(task, spec=own)).parameters()
    factors = rng.uniform(1 - options.off, 1 + options.off, len(usual))

    def plant() -> Any:
        return scaled(original.make(task, spec=own), tuple(usual), factors)

    truth, real = adjustable(plant()).parameters(), taken(plant(), rng, options.steps)
    prior = surrogym.Prior(f"mujoco:{FILES / FILE[task]}", spec, list(usual))
    prior.calibrate(real)
    found = prior.calibration
    assert found is not None
    known = [one for one in found.parameters if one.determined]
    wrong = max((abs(one.value / truth[one.name] - 1) for one in known), default=float("nan"))
    inside = sum(one.low <= truth[one.name] <= one.high for one in found.parameters)
    print(
        f"{task} {seed}: {len(real)} real steps, error {found.error_before:.3g} -> {found.error:.2g}; {len(known)} of "
        f"{len(usual)} parameters determined, within {wrong:.2g}; {inside} intervals with the true value; "
        f"{time.process_time() - begun:.0f} s"
    )
    for words, values in (("calibrated", found.values), ("as it is", usual)):
        if not options.searches or words not in options.arms:
            continue
        begun = time.process_time()
        adjustable(prior.simulator).set_parameters(values)
        earned = returns(task, prior.stepped(), plant, options.searches, seed)
        print(f"{task} {seed}, {words}: {earned}; {time.process_time() - begun:.0f} s")


def taken(plant: Any, rng: np.random.Generator, count: int) -> list[RealStep]:
    """Random steps from resets; each action is held for one to four steps. An episode ends at its time limit."""
    steps, left, spec = list[RealStep](), 0, plant.spec()
    while len(steps) < count:
        action = rng.uniform(spec.action.low, spec.action.high)
        for _ in range(rng.integers(1, 5)):
            if left == 0:
                plant.begin(int(rng.integers(2**31)))
                left = spec.time_limit
            steps.append(plant.act(action))
            left = 0 if steps[-1].terminated else left - 1
    return steps[:count]


def returns(task: str, model: LocalSurrogate, plant: Callable[[], Any], searches: int, seed: int) -> str:
    steps, longest, population, starts, sigma = SEARCH[task]
    choices = {"units": 0, "population": population, "starts": starts, "sigma": sigma}
    best, imagined = None, list[float]()
    with TemporaryDirectory() as folder:
        for number in range(searches):
            chosen = TrainSettings(
                "CMAES", steps, seed=100 * seed + number, session={"time_limit": longest}, hyperparameters=choices
            )
            result = train(model, Path(folder, f"{number}.zip"), chosen)
            imagined.append(float(result.imagined_return or 0.0))
            if imagined[-1] == max(imagined):
                best = load_policy(result.path)
    assert best is not None
    episode = open_episode("", plant().spec(), plant)
    found = evaluate(best, lambda: episode, EvaluationSettings(20, parallel=1))
    seen = ", ".join(f"{one:.0f}" for one in imagined)
    return f"real return {np.mean(found.returns):.0f} (least {np.min(found.returns):.0f}); in the simulator {seen}"


if __name__ == "__main__":
    main()
