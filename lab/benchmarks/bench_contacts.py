"""Simulators with contacts: calibrated on random real steps, and then stepped themselves instead of a model of them.

    python lab/benchmarks/bench_contacts.py --tasks Swimmer-v5 Hopper-v5 HalfCheetah-v5 Pusher-v5 --seeds 10 11
    python lab/benchmarks/bench_contacts.py --tasks Swimmer-v5 Hopper-v5 HalfCheetah-v5 --seeds 14 15 --searches 3
    python lab/benchmarks/bench_contacts.py --tasks ball_in_cup-catch finger-spin --seeds 8 9 --searches 1

The simulator is the task's MuJoCo file. For each seed, all masses, damping, friction and gears of the plant are the
file's, times factors drawn evenly from 0.7 to 1.3 (``--off 0.3``). The plant takes ``--steps`` random steps from
resets, on which the simulator is calibrated. A row has its errors (of the standard deviation of the changes) before and
after, the largest relative error of a parameter that the steps determine, and the number of 90 % intervals with the
true value. With ``--searches N``, N searches train policies in the calibrated simulator, and in the simulator as it is.
The one with the best return in that simulator takes 20 real episodes, whose mean return is printed.

``ball_in_cup-catch`` and ``finger-spin`` need dm_control.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

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

# The task's file, and a declared reward of a policy search, if it is not the task's own: a coordinate, less a weight
# times the squared actions. Hopper's 1 for each step is left out, because standing earns it.
FILE = {
    "Swimmer-v5": "swimmer.xml",
    "Hopper-v5": "hopper.xml",
    "HalfCheetah-v5": "half_cheetah.xml",
    "Pusher-v5": "pusher_v5.xml",
    "ball_in_cup-catch": "ball_in_cup.xml",
    "finger-spin": "finger.xml",
}
REWARDS = {
    "Swimmer-v5": ("slider1_velocity", 1e-4),
    "Hopper-v5": ("rootx_velocity", 1e-3),
    "HalfCheetah-v5": ("rootx_velocity", 0.1),
}
HOPPER = (("rootz", "<=", 0.7), ("rooty", ">=", 0.2), ("rooty", "<=", -0.2))  # ends of an episode of Gymnasium's
# The first search for finger-spin is paid for the speed, in units of the 15 rad/s that the task asks, up to this value.
# The second one continues it for the task's own reward.
SPEED = Quantity(term=Term.linear(hinge_velocity=-1 / 15).clipped(None, 1.2))


def _linear(steps: int, longest: int, population: int, starts: int, sigma: float) -> TrainSettings:
    """A search for linear policies by CMA-ES in episodes of at most ``longest`` steps."""
    choices = {"units": 0, "population": population, "starts": starts, "sigma": sigma}
    return TrainSettings("CMAES", steps, session={"time_limit": longest}, hyperparameters=choices)


def _network(steps: int, start_box: float, horizon: int | None, **choices: Any) -> TrainSettings:
    """A search by PPO in one cycle."""
    return TrainSettings("FASTPPO", steps, start_box=start_box, horizon=horizon, hyperparameters=choices)


# Settings of searches, chosen with seeds 1 to 3 and the file's own parameters. Each continues the policy of the one
# before.
SEARCH = {
    "Swimmer-v5": (_linear(400_000, 1_000, 12, 1, 0.3),),
    "Hopper-v5": (_linear(1_400_000, 1_000, 24, 1, 0.3),),
    "HalfCheetah-v5": (_linear(3_000_000, 500, 24, 2, 0.5),),
    "Pusher-v5": (_network(1_500_000, 0.0, None, gamma=0.97, n_steps=50),),
    "ball_in_cup-catch": (TrainSettings("FASTPPO"),),
    "finger-spin": (
        _network(3_000_000, 1.0, 100, gamma=0.95, n_steps=32),
        _network(9_000_000, 1.0, 100, gamma=0.95, n_steps=32, learning_rate=5e-4),
    ),
}
SUITE = Path(__file__).parent / "larger"  # specifications of dm_control's tasks
PERIOD = 0.02  # their sampling period, in seconds


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


def opened(task: str, spec: EnvironmentSpec) -> Any:
    """The task, whose episodes can be begun."""
    gymnasium = task.endswith("-v5")
    return (
        original.make(task, spec=spec) if gymnasium else original.make(f"dm_control:{task}", spec=spec, access="reset")
    )


def own_specification(task: str) -> EnvironmentSpec:
    if task.endswith("-v5"):
        return describe(task).spec
    read = json.loads((SUITE / f"{task}.json").read_bytes())
    spec = EnvironmentSpec.model_validate(read.get("specification", read))
    return spec.model_copy(update={"sampling_period": PERIOD})


def file_of(task: str) -> Path:
    if task.endswith("-v5"):
        import gymnasium.envs.mujoco as package

        return Path(package.__file__).parent / "assets" / FILE[task]
    from dm_control import suite

    return Path(suite.__file__).parent / FILE[task]


def specification(task: str) -> EnvironmentSpec:
    """The task's specification, with the reward and the ends of episodes of a policy search."""
    spec = own_specification(task)
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
    changed: dict[str, Any] = {"reward": reward.model_dump()}
    if task == "Hopper-v5":
        changed["termination"] = [[end.model_dump() for end in group] for group in ends]
    return EnvironmentSpec.model_validate(spec.model_dump() | changed)


def rewards(task: str, spec: EnvironmentSpec) -> list[EnvironmentSpec]:
    """Specifications with the rewards of the searches for the task, one after the other."""
    if task != "finger-spin":
        return [spec]
    fast = DeclaredReward(kind="declared", timing="after", terms=(RewardTerm(shape="linear", of=(SPEED,)),))
    return [spec.model_copy(update={"reward": fast}), spec]


def run(task: str, spec: EnvironmentSpec, seed: int, options: argparse.Namespace) -> None:
    rng, begun, own = np.random.default_rng([seed, 58]), time.process_time(), own_specification(task)
    usual = adjustable(opened(task, own)).parameters()
    factors = rng.uniform(1 - options.off, 1 + options.off, len(usual))

    def plant() -> Any:
        return scaled(opened(task, own), tuple(usual), factors)

    real, begun_plant = taken(plant(), rng, options.steps), plant()
    begun_plant.begin(0)  # a task may set parameters then, as finger-spin does with a damping
    truth = adjustable(begun_plant).parameters()
    file = f"mujoco:{file_of(task)}"
    simulator: Any = file
    if spec.reward.kind == "declared":  # a task may set other values than its file, as finger-spin's damping
        simulator = original.make(file, spec=spec.model_copy(update={"environment": file}))
        adjustable(simulator).set_parameters(usual)
    prior = surrogym.Prior(simulator, spec, list(usual))
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
    if spec.reward.kind != "declared":  # a file has no reward, so a policy is trained in the task's program
        simulator = opened(task, own)
    searched = [surrogym.Prior(simulator, one, list(usual)) for one in rewards(task, spec)]
    for words, values in (("calibrated", found.values), ("as it is", usual)):
        if not options.searches or words not in options.arms:
            continue
        begun = time.process_time()
        searched[0].set_parameters(values)  # of the simulator that all share
        earned = returns(task, [one.stepped() for one in searched], plant, options.searches, seed)
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


def returns(task: str, models: list[LocalSurrogate], plant: Callable[[], Any], searches: int, seed: int) -> str:
    best, imagined = None, list[float]()
    with TemporaryDirectory() as folder:
        for number in range(searches):
            policy = None
            for stage, (model, settings) in enumerate(zip(models, SEARCH[task], strict=True)):
                settings = replace(settings, seed=100 * seed + number, start_from=policy)
                result = train(model, Path(folder, f"{number}-{stage}.zip"), settings)
                policy = result.path
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
