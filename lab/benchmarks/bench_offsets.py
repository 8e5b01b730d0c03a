"""Steady error of planners and trained policies in plants that differ from the model, and at other set points.

    python lab/benchmarks/bench_offsets.py --plants tanks reactor --seeds 345 346
    python lab/benchmarks/bench_offsets.py --plants tanks --seeds 347 348 --set-points
    python lab/benchmarks/bench_offsets.py --seeds 372 373 --limits
    python lab/benchmarks/bench_offsets.py --plants rotary --seeds 347 348
    python lab/benchmarks/bench_offsets.py --plants tanks --seeds 353 354 --integral

The plants are two tanks, whose lower level is to be 10 cm, and a reactor whose concentration is to be 0.42 mol/l. Each
seed has one model, learned from any state, and ten episodes in the plant as it was learned, in one whose actuator is
20 % weaker, and in one that adds 5 % of the action's range to each action. The steady error of an episode is the mean
distance from the set point over its last 40 steps. The plants have no noise in these episodes.

The rotary pendulum of ``audit_resets.py``, whose arm is to rest at 0 rad, is learned from resets. With its lags it has
five coordinates, too many for a planner.

With ``--integral`` the specification declares the reward, and a second policy is trained that also sees the integral of
the error.

With ``--set-points`` the specification declares the reward, and the plants stay as they were learned. For each of two
other set points a planner on the model gets it at run time, and a policy is trained in the same model with a
specification of this set point. Returns are those of the reward with this set point.

With ``--limits`` a planner gets a limit at run time that its best way leaves, in the plant as learned and in changed
ones. Rows have the share of steps beyond the limit, and the least distance from it, negative beyond it.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import numpy as np
import torch
from audit_resets import MACHINES, Rotary
from bench_kept_limits import REACTOR

import surrogym
from support.changing import Array, Changing, Machine, Parameters
from support.levitation import TANKS
from surrogym_sampler.original import RealStep
from surrogym_sampler.original.episodes import RolloutEpisode
from surrogym_sampler.original.rollouts import FromReset
from surrogym_server.local import LocalSurrogate
from surrogym_server.planning import planner_of
from surrogym_shared.limits import distances, limit_of
from surrogym_shared.set_points import with_set_points
from surrogym_shared.spec import DeclaredReward, EnvironmentSpec, Quantity, RewardTerm, Term
from surrogym_trainer.evaluation.evaluator import EvaluationSettings, evaluate
from surrogym_trainer.policies import load_policy
from surrogym_trainer.policies.integrals import acting_with_integrals
from surrogym_trainer.policies.predict import Acting, PerEpisode
from surrogym_trainer.training import TrainSettings, train

EPISODES, LAST, SEARCH, HORIZON = 10, 40, "FASTPPO", 12
NUMBERS = itertools.count()  # of episodes


@dataclass(frozen=True)
class Plant:
    """A machine with one coordinate that has a set point."""

    machine: Machine
    coordinate: int  # index of the coordinate
    target: float  # its set point
    width: float  # error at which the reward is exp(-1/2)
    off: float  # action at which the actuator does nothing
    others: tuple[float, ...]  # other set points
    limited: tuple[float, str]  # a set point, and a limit that the best way to it leaves

    @property
    def name(self) -> str:
        return list(self.machine.ranges)[self.coordinate]

    def reward(self, q: Array) -> Array:
        """Return the rewards (n,) of states q (n, C)."""
        found: Array = np.exp(-0.5 * ((q[:, self.coordinate] - self.target) / self.width) ** 2)
        return found

    def declared(self) -> EnvironmentSpec:
        """Return the machine's specification with a declared reward."""
        error = Term.linear(**{self.name: 1 / self.width}) + Term.constant(-self.target / self.width)
        reward = DeclaredReward(kind="declared", terms=(RewardTerm(shape="bump", of=(Quantity(term=error),)),))
        return self.machine.spec.model_copy(update={"reward": reward})


PLANTS = {
    "tanks": Plant(TANKS, 1, 0.0, 1.0, -1.0, (-4.0, 4.0), (4.0, "upper<=6")),
    "reactor": Plant(REACTOR, 0, 0.42, 0.1, 0.0, (0.35, 0.5), (0.42, "temperature+40*concentration<=23")),
}
CHANGES = {"as learned": (1.0, 0.0), "20 % weaker": (0.8, 0.0), "offset of 5 %": (1.0, 0.1)}  # factor, offset


def learned(plant: Plant, seed: int, spec: EnvironmentSpec) -> LocalSurrogate:
    """Learn a model of the plant by a design from any state."""
    real = Changing(plant.machine, plant.machine.real, np.random.default_rng([seed, 5]))
    chosen = spec.design.model_copy(update={"seed": seed, "budget": plant.machine.budget})
    spec = spec.model_copy(update={"design": chosen})
    design = surrogym.Design(spec)
    while (query := design.ask()) is not None:
        design.tell(query, real.step_from(np.array(query.coordinates), np.array(query.action)))
    return design.surrogate()


def of_seed(seed: int, integral: tuple[str, ...]) -> TrainSettings:
    return TrainSettings(algorithm=SEARCH, seed=seed, integral=integral)


def trained(model: LocalSurrogate, seed: int, integral: tuple[str, ...] = ()) -> Acting:
    with TemporaryDirectory() as folder:
        result = train(model, Path(folder) / "policy", of_seed(seed, integral))
        return acting_with_integrals(load_policy(result.path, SEARCH), model.spec(), integral, {})


def measured(plant: Plant, acts: Acting, change: str, seed: int) -> tuple[float, float, Array]:
    """Return the mean steady error, the mean return, and the states (T, N, C) after the T steps of the N episodes."""
    factor, offset = CHANGES[change]
    formula: Callable[[Array, Array, Parameters], tuple[Array, Array]] = plant.machine.formula

    def changed(q: Array, u: Array, parameters: Parameters) -> tuple[Array, Array]:
        return formula(q, plant.off + factor * (u - plant.off) + offset, parameters)

    machine = replace(plant.machine, formula=changed, noise=0.0)
    rng = np.random.default_rng([seed, 77])
    low, high = np.array(list(machine.start.values())).T
    q, total, path = rng.uniform(low, high, (EPISODES, len(low))), np.zeros(EPISODES), []
    numbers = [next(NUMBERS) for _ in range(EPISODES)]
    for _ in range(machine.time_limit):
        shown = machine.observe(q)
        chosen = acts.actions(numbers, shown) if isinstance(acts, PerEpisode) else acts(shown)
        u = np.asarray(chosen, dtype=float).reshape(EPISODES, -1)
        total += plant.reward(q)
        q = machine.step(q, u, machine.real, rng)[0]
        path.append(q)
    states = np.array(path)
    steady = np.abs(np.mean(states[-LAST:, :, plant.coordinate] - plant.target, axis=0))
    return float(steady.mean()), float(total.mean()), states


def at_set_points(name: str, seed: int) -> None:
    """Print a row for each of the other set points of a plant."""
    plant = PLANTS[name]
    model = learned(plant, seed, plant.declared())
    for target in plant.others:
        points, aimed = {plant.name: target}, replace(plant, target=target)
        own = LocalSurrogate.from_bytes(with_set_points(model.spec(), points), model.model_file())
        policies: dict[str, Acting] = {"planner": model.planner(HORIZON, set_points=points)}
        policies["trained"] = trained(own, seed)
        for policy, acts in policies.items():
            error, total, _ = measured(aimed, acts, "as learned", seed)
            print(f"| {name} | {seed} | {target:g} | {policy} | {error:.2g} | {total:.3g} |", flush=True)


def at_limits(name: str, seed: int) -> None:
    """Print a row for each change of a plant, without and with a limit."""
    plant = PLANTS[name]
    model, (target, limit) = learned(plant, seed, plant.declared()), plant.limited
    keep = [limit_of(model.spec(), limit)]
    for limits in ((), (limit,)):
        acts = model.planner(HORIZON, set_points={plant.name: target}, limits=limits)
        for change in CHANGES:
            error, total, states = measured(replace(plant, target=target), acts, change, seed)
            room = distances(model.spec(), keep, states.reshape(-1, states.shape[2]))
            kept = f"{', '.join(limits) or 'none'} | {100 * (room < 0).mean():.2g} % | {room.min():.3g}"
            print(f"| {name} | {seed} | {change} | {kept} | {error:.2g} | {total:.3g} |", flush=True)


class WeakerRotary(Rotary):
    TORQUE = 0.8 * Rotary.TORQUE


class OffsetRotary(Rotary):
    def step(self, action: Any) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        return super().step(np.asarray(action) + 0.1)


def learned_rotary(seed: int) -> LocalSurrogate:
    """Learn a model of the rotary pendulum from resets, with its reward declared."""
    reward = DeclaredReward(
        kind="declared",
        terms=(
            RewardTerm(weight=0.5, shape="one"),
            RewardTerm(weight=0.5, shape="linear", of=(Quantity(term=Term.cos(tilt=1)),)),
            RewardTerm(weight=-0.02, shape="square", of=(Quantity(term=Term.linear(arm=1)),)),
        ),
    )
    spec = Rotary().spec()
    chosen = spec.design.model_copy(update={"seed": seed, "budget": MACHINES["rotary"][1]})
    design = surrogym.Design(spec.model_copy(update={"reward": reward, "design": chosen}))
    real, seeds = FromReset(Rotary()), np.random.default_rng(seed)
    while (query := design.ask()) is not None:
        real.begin(int(seeds.integers(2**31)))
        steps: list[RealStep] = []
        for action in query.actions:
            steps.append(real.act(np.array(action)))
            if steps[-1].terminated or steps[-1].truncated:
                break
        design.tell(query, steps)
    return design.surrogate()


def of_rotary(seed: int) -> None:
    """Print the rows of two policies of the rotary pendulum, the second with the integral of the arm's error. The error
    is followed by the mean cosine of the tilt in the same steps, which is 1 for a pendulum that is held upright."""
    model = learned_rotary(seed)
    settings = EvaluationSettings(EPISODES, first_seed=1_000 * seed, parallel=EPISODES)
    for policy, integral in (("trained", ()), ("trained, integral", ("arm",))):
        with TemporaryDirectory() as folder:
            acts = load_policy(train(model, Path(folder) / "policy", of_seed(seed, integral)).path, SEARCH)
        for change, kind in zip(CHANGES, (Rotary, WeakerRotary, OffsetRotary), strict=True):
            acting = acting_with_integrals(acts, model.spec(), integral, {})
            found = evaluate(acting, partial(opened, kind), settings)
            last = [trace.coordinates[-LAST:] for trace in found.traces]
            error, held = np.mean([abs(q[:, 0].mean()) for q in last]), np.mean([np.cos(q[:, 1]) for q in last])
            returned = found.returns.mean()
            print(f"| rotary | {seed} | {policy} | {change} | {error:.2g} ({held:.2g}) | {returned:.3g} |", flush=True)


def opened(kind: type[Rotary]) -> RolloutEpisode:
    return RolloutEpisode(FromReset(kind()))


def main() -> None:
    torch.set_num_threads(1)
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--plants", nargs="+", choices=[*PLANTS, "rotary"], default=list(PLANTS))
    options.add_argument("--seeds", nargs="+", type=int, default=[345, 346])
    options.add_argument("--no-training", action="store_true", help="planners alone")
    options.add_argument("--set-points", action="store_true", help="other set points, in the plant as learned")
    options.add_argument("--limits", action="store_true", help="planners with a limit at run time")
    options.add_argument("--integral", action="store_true", help="also a policy that sees the integral of the error")
    given = options.parse_args()
    if "rotary" in given.plants and (given.set_points or given.limits):
        options.error("the rotary pendulum has no rows of other set points or limits: leave it out")
    if given.limits:
        print(
            f"| plant | seed | change | limit | beyond | least distance | steady error | return |\n{'|---' * 8}|",
            flush=True,
        )
        for name in given.plants:
            for seed in given.seeds:
                at_limits(name, seed)
        return
    if given.set_points:
        print("| plant | seed | set point | policy | steady error | return |\n|---|---|---|---|---|---|", flush=True)
        for name in given.plants:
            for seed in given.seeds:
                at_set_points(name, seed)
        return
    print("| plant | seed | policy | change | steady error | return |\n|---|---|---|---|---|---|", flush=True)
    for name in given.plants:
        for seed in given.seeds:
            if name == "rotary":
                of_rotary(seed)
                continue
            plant = PLANTS[name]
            model = learned(plant, seed, plant.declared() if given.integral else plant.machine.spec)
            policies: dict[str, Acting] = {"planner": planner_of(model.model, HORIZON)}
            if not given.no_training:
                policies["trained"] = trained(model, seed)
            if given.integral:
                policies["trained, integral"] = trained(model, seed, (plant.name,))
            for policy, acts in policies.items():
                for change in CHANGES:
                    error, total, _ = measured(plant, acts, change, seed)
                    print(f"| {name} | {seed} | {policy} | {change} | {error:.2g} | {total:.3g} |", flush=True)


if __name__ == "__main__":
    main()
