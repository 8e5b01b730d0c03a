"""How well limits hold while a machine is learned that can only be reset, and what they cost.

    python lab/benchmarks/bench_kept_limits.py --machines rail tanks levitation --first-seed 1 --seeds 10
    python lab/benchmarks/bench_kept_limits.py --machines rotary --no-policy --first-seed 1 --seeds 10
    python lab/benchmarks/bench_kept_limits.py --machines tanks levitation --reference 300000 --first-seed 1
    python lab/benchmarks/bench_kept_limits.py --machines rail tanks --random 500 --first-seed 1

The machines are the cart-pole swing-up on a rail of +-0.8 m, two tanks of which the upper one runs over, a levitated
ball that must be held, a reactor that must not run away, a quadrotor between floor and ceiling, and a rotary pendulum
whose arm must stay within +-1.5 rad and is only seen by an encoder, one step late. A row has one design and one policy,
with limits or without:

- real steps and rollouts of the design, and how many rollouts left a limit;
- the mean real return of ``--episodes`` episodes of a policy on the model (a network that is trained, or with
  ``--planner`` a planner), how many of them left a limit, and the share of steps in which the fallback acted; how many
  episodes had a fallback, and the share that the promise expected;
- the same policy in a changed machine (a ball and a quadrotor 30 % heavier, a pump 20 % stronger, 10 % more heat of
  reaction), of which neither model nor policy nor fallback knows.

Each row is judged by the physical quantity that must stay in its range, such as the position of the cart. The declared
limit may be of another term, such as the position plus the way of 0.2 s. Rows are saved in ``--out``/limits.csv, so
that the same command continues after Ctrl-C. ``--reference`` trains a policy by PPO in the plant itself, with the same
guard: a measure for the returns of policies that a model trained; with ``--unpaid`` its episodes earn nothing from the
first fallback on. ``--shares`` prints the expected and the real share of the episodes of each policy with a fallback,
for several sizes of the limit. ``--random`` takes episodes of random actions, each of which is held for some steps,
with the guard and without.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import numpy as np
import torch
from audit_resets import Rotary
from common import OUT
from gymnasium import spaces
from scipy.stats import binomtest
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

import surrogym
from support import levitation
from support.changing import Array, Machine, Parameters
from surrogym_lab.reproduce.rows import read_records, write_records
from surrogym_sampler import original
from surrogym_sampler.original.episodes import open_episode
from surrogym_sampler.original.limits import Guard
from surrogym_sampler.original.loading import Respecified
from surrogym_sampler.original.rollouts import answering, keeping_limits
from surrogym_server.local import LocalSurrogate
from surrogym_shared.limits import clipped_action, falls_back, past
from surrogym_shared.port import horizon_of
from surrogym_shared.spec import EnvironmentSpec, Limit, Limits, Term, limits
from surrogym_shared.terms import evaluate as value_of
from surrogym_trainer.evaluation.evaluator import FIRST_SEED
from surrogym_trainer.evaluation.promise import promise_of
from surrogym_trainer.policies import load_policy
from surrogym_trainer.policies.predict import Predict
from surrogym_trainer.training import TrainSettings, train

REFERENCE_EPISODES = 500
SCALES = (0.8, 0.9, 1.0, 1.1, 1.2, 1.3, 1.4, 1.5, 1.6)  # factors of the physical limit for ``--shares``
SEARCH = "FASTPPO"
# The levitated ball, linearised about its middle: the direction in which it runs away, and a state feedback (LQR).
# Beyond 2.1 in this direction no voltage holds it any more.
RUNS_AWAY = Term.linear(gap=1.0, speed=22.6, current=-5.2)
HOVERING = Term.linear(gap=1.53, speed=31.5, current=-6.38)


def _reactor(q: Array, u: Array, p: Parameters) -> tuple[Array, Array]:
    """A stirred tank with an exothermic reaction: concentration in mol/l, temperature in K about 350. The action is the
    coolant's temperature, 300 K +- 20 K. A concentration of 0.42 is wanted, near to where the reaction runs away."""
    c, t, coolant = q[..., 0], q[..., 1] + 350, 300 + 20 * u[..., 0]

    def rates(c: Array, t: Array) -> tuple[Array, Array]:
        rate = 7.2e10 * np.exp(-8750 / t) * c
        return 1 - c - rate, 350 - t + 209.2 * p["heat"] * rate + 2.092 * (coolant - t)

    for _ in range(REACTOR_PARTS):
        first = rates(c, t)
        half = 0.5 * REACTOR_DT / REACTOR_PARTS
        second = rates(c + half * first[0], np.minimum(t + half * first[1], RELIEF))
        c, t = c + 2 * half * second[0], np.minimum(t + 2 * half * second[1], RELIEF)
    return np.stack([c, t - 350], -1), np.exp(-0.5 * ((q[..., 0] - 0.42) / 0.1) ** 2)


def _quadrotor(q: Array, u: Array, p: Parameters) -> tuple[Array, Array]:
    """The height of a quadrotor in m about the middle between floor and ceiling, its speed, and the acceleration of its
    rotors, which follow the action with 0.1 s. A height above the ceiling of 1 m is wanted: 1.1 m."""
    height, speed, push = q[..., 0], q[..., 1], q[..., 2]
    for _ in range(QUADROTOR_PARTS):
        push = push + 0.01 / 0.1 * (6 * u[..., 0] / p["mass"] - push)
        speed = speed + 0.01 * (push - 0.3 * speed * np.abs(speed))
        height = height + 0.01 * speed
    return np.stack([height, speed, push], -1), np.exp(-0.5 * ((q[..., 0] - 1.1) / 0.4) ** 2)


REACTOR_DT, REACTOR_PARTS, RELIEF = 0.05, 20, 400.0  # minutes of a step, and steps of the midpoint rule; K
QUADROTOR_PARTS = 5  # Euler steps of 0.01 s
REACTOR = Machine(
    "reactor",
    {"concentration": (0.0, 1.0), "temperature": (-40, 50)},
    {"concentration": (0.7, 0.9), "temperature": (-30, -20)},
    _reactor,
    real={"heat": 1.0},
    wrong={},
    few=(8, 16),
    budget=120,
    noise=0.001,
    time_limit=100,
)
QUADROTOR = Machine(
    "quadrotor",
    {"height": (-1.5, 1.5), "speed": (-3, 3), "push": (-6, 6)},
    {"height": (-0.2, 0.2), "speed": (-0.1, 0.1), "push": (-0.1, 0.1)},
    _quadrotor,
    real={"mass": 1.0},
    wrong={},
    few=(8, 16),
    budget=80,
    noise=0.001,
    time_limit=100,
)


TANKS = replace(levitation.TANKS, start={"upper": (-5, 0), "lower": (-5, 0)})
LEVITATION = replace(
    levitation.LEVITATION,
    start={"gap": (-0.5, 0.5), "speed": (-0.008, 0.008), "current": (-0.03, 0.03)},
    ends=None,
)


class Formula:
    """A plant from a formula, which can only be reset and acted on."""

    parallel = True

    def __init__(self, machine: Machine, seed: int) -> None:
        self._machine, self._rng = machine, np.random.default_rng([seed, 5])
        self._q = np.zeros(len(machine.ranges))

    def spec(self) -> EnvironmentSpec:
        return self._machine.spec

    def reset(self, *, seed: int | None = None) -> tuple[Any, dict[str, Any]]:
        low, high = np.array(list(self._machine.start.values())).T
        self._q = np.random.default_rng(seed).uniform(low, high)
        return self._q.copy(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        u = np.atleast_1d(np.asarray(action, dtype=float))[None]
        after, reward, over = self._machine.step(self._q[None], u, self._machine.real, self._rng)
        self._q = after[0]
        return self._q.copy(), float(reward[0]), bool(over[0]), False, {}

    def coordinates(self, observation: Any) -> Any:
        return observation

    def close(self) -> None:
        pass


def _with(machine: Machine, **parameters: float) -> Callable[[int], Any]:
    """Return a function that makes a machine with other parameters."""
    return partial(Formula, replace(machine, real={**machine.real, **parameters}))


class PatientRotary(Rotary):
    """The rotary pendulum as a simulator, which waits for its actions."""

    parallel = True


@dataclass(frozen=True)
class Plant:
    """One machine with its limits."""

    make: Callable[[int], Any]  # makes the machine, of a seed
    limits: Limits
    physical: Limit  # by which every row is judged
    changed: Callable[[int], Any]  # makes the machine as it is after a change of which neither model nor policy knows
    budget: int
    period: float  # seconds of a step
    changes: dict[str, Any]  # of the specification


def _limits(fallback: Term, *keep: Limit) -> Limits:
    return Limits(keep=keep, fallback=(fallback,))


PLANTS = {
    "rail": Plant(
        lambda _: original.make("surrogym/CartPoleSwingUp-v0", access="reset"),
        _limits(
            Term.linear(x=-8.0, velocity=-6.0),
            # chosen with --random on seed 0
            Limit(name="rail", term=Term.linear(x=1.0, velocity=0.2), low=-0.8, high=0.8, margin=0.4),
        ),
        Limit(name="rail", term=Term.linear(x=1.0), low=-0.8, high=0.8),
        lambda _: original.make("surrogym/CartPoleSwingUp-v0", access="reset"),
        budget=260,
        period=0.1,
        changes={},
    ),
    "tanks": Plant(
        _with(TANKS),
        _limits(Term.constant(-1.0), Limit(name="brim", term=Term.linear(upper=1.0), high=3.0, margin=0.7)),
        Limit(name="brim", term=Term.linear(upper=1.0), high=3.0),
        _with(TANKS, pump=1.2),
        budget=60,
        period=0.5,
        changes={},
    ),
    "levitation": Plant(
        _with(LEVITATION),
        _limits(HOVERING, Limit(name="held", term=RUNS_AWAY, low=-2.1, high=2.1, margin=1.1)),
        Limit(name="held", term=RUNS_AWAY, low=-2.1, high=2.1),
        _with(LEVITATION, mass=1.3),
        budget=100,
        period=0.005,
        changes={},
    ),
    "reactor": Plant(
        _with(REACTOR),
        # Beyond 358 K at 0.5 mol/l, less 40 K for each mol/l, the coldest coolant no longer stops the reaction.
        _limits(
            Term.constant(-1.0),
            Limit(name="runaway", term=Term.linear(temperature=1.0, concentration=40.0), high=28.0, margin=5.0),
        ),
        Limit(name="temperature", term=Term.linear(temperature=1.0), high=20.0),
        _with(REACTOR, heat=1.1),
        budget=300,
        period=3.0,
        changes={},
    ),
    "quadrotor": Plant(
        _with(QUADROTOR),
        _limits(
            Term.linear(height=-1.5, speed=-1.2, push=-0.1),
            Limit(name="room", term=Term.linear(height=1.0, speed=0.3, push=0.03), low=-1.0, high=1.0, margin=0.15),
        ),
        Limit(name="height", term=Term.linear(height=1.0), low=-1.0, high=1.0),
        _with(QUADROTOR, mass=1.3),
        budget=80,
        period=0.05,
        changes={},
    ),
    "rotary": Plant(
        lambda _: PatientRotary(),
        _limits(
            Term.linear(**{"arm": -0.6, "arm.change1": -4.0}),
            Limit(name="stop", term=Term.linear(**{"arm": 1.0, "arm.change1": 2.0}), low=-1.5, high=1.5, margin=0.5),
        ),
        Limit(name="stop", term=Term.linear(arm=1.0), low=-1.5, high=1.5),
        lambda _: PatientRotary(mass=1.3),
        budget=300,
        period=0.03,
        changes={},
    ),
}


@dataclass(frozen=True)
class Row:
    """One design and its policy."""

    machine: str
    limits: bool  # whether the limits were declared
    seed: int
    phase: str
    steps: int  # real steps of the design
    rollouts: int
    left: int  # rollouts that left a limit
    value: float  # mean real return of the policy; nan without one
    episodes: int
    violations: int  # episodes that left a limit
    fallbacks: float  # share of the policy's steps in which the fallback acted
    fell_back: int  # episodes in which the fallback acted
    expected: float  # predicted share of such episodes; nan without limits
    changed: int  # of as many episodes of the policy in the changed machine, those that left a limit


def main() -> None:
    options = _options()
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    torch.set_num_threads(1)
    path: Path = options.out / "limits.csv"
    path.parent.mkdir(parents=True, exist_ok=True)
    if options.time:
        for machine in options.machines:
            print(machine, "guard, ms: median {:.3f}, 99th percentile {:.3f}".format(*guard_times(machine)))
        return
    if options.reference:
        for machine in options.machines:
            found = reference(machine, options.first_seed, options.reference, unpaid=options.unpaid)
            words = (
                "PPO in the plant: mean return {:.4g}, {} of {} episodes left, fallback in {} and {:.1%} of the steps"
            )
            print(machine, words.format(*found))
        return
    if options.random:
        for machine in options.machines:
            for limited in (True, False):
                kept = random_episodes(machine, options.first_seed, options.random, limited=limited)
                words = "with" if limited else "without"
                print(machine, words, "limits: {} of {} left, fallback in {:.0%} of the steps".format(*kept))
        return
    rows = read_records(path, Row)
    done = {(row.machine, row.limits, row.seed) for row in rows}
    for seed in range(options.first_seed, options.first_seed + options.seeds):
        for machine in options.machines:
            for limited in (True, False):
                left_out = options.without_limits_only if limited else options.with_limits_only
                if not left_out and (machine, limited, seed) not in done:
                    rows.append(run(machine, seed, options, limited=limited))
                    write_records(path, Row, rows)
                    print(rows[-1])
    print(table(rows))


class Guarded(VecEnv):
    """Episodes of a formula's machine, or of the changed one, in N lanes. The guard of the sampler keeps the limits if
    it is on. If ``unpaid``, an episode earns nothing from its first fallback on, as in virtual episodes."""

    def __init__(
        self,
        machine: str,
        lanes: int,
        seed: int,
        *,
        guard: bool = True,
        changed: bool = False,
        unpaid: bool = False,
        spec: EnvironmentSpec | None = None,
    ) -> None:
        plant = PLANTS[machine]
        self.spec, self.guard, self.unpaid = spec or specifications(plant, 0)[0], guard, unpaid
        self.judged = spec or _judging(plant, self.spec)
        self.plant: Machine = (plant.changed if changed else plant.make)(0)._machine
        size = len(self.plant.ranges)
        low, high = np.array(self.spec.action.ranges, dtype=np.float32).T
        super().__init__(lanes, spaces.Box(-np.inf, np.inf, (size,)), spaces.Box(low, high))
        self.rng = np.random.default_rng([seed, 6])

    def reset(self) -> Array:
        low, high = np.array(list(self.plant.start.values())).T
        self.q = self.before = self.rng.uniform(low, high, (self.num_envs, len(low)))
        self.steps, self.earned, self.left = 0, np.zeros(self.num_envs), np.zeros(self.num_envs, dtype=bool)
        self.fallbacks = np.zeros(self.num_envs, dtype=int)
        return self.q.astype(np.float32)

    def step_async(self, actions: Array) -> None:
        self.asked = actions

    def step_wait(self) -> tuple[Array, Array, Array, list[dict[str, Any]]]:
        near = falls_back(self.spec, self.before, self.q) & self.guard
        (term,) = self.spec.limits.fallback
        applied = np.where(near, clipped_action(self.spec, value_of(self.spec, term, self.q)), self.asked[:, 0])
        self.before = self.q
        self.q, reward, _ = self.plant.step(self.q, applied[:, None], self.plant.real, self.rng)
        self.steps += 1
        self.fallbacks += near
        reward = np.where(self.unpaid & (self.fallbacks > 0), 0.0, reward)
        self.earned += reward
        self.left |= past(self.judged, self.q)
        ends, infos = self.steps == self.plant.time_limit, [{} for _ in range(self.num_envs)]
        seen = self.q.astype(np.float32)
        if ends:
            infos = [{"terminal_observation": one, "TimeLimit.truncated": True} for one in seen]
            seen = self.reset()
        return seen, reward.astype(np.float32), np.full(self.num_envs, ends), infos

    def close(self) -> None:
        pass

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [None] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise NotImplementedError

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs


def reference(machine: str, seed: int, steps: int, *, unpaid: bool) -> tuple[float, int, int, int, float]:
    """Train a policy by PPO in the plant itself with its guard. Return the mean return of ``REFERENCE_EPISODES``
    episodes, how many of them left a limit, their number, how many had a fallback, and its share of the steps."""
    trained = VecNormalize(Guarded(machine, 64, seed, unpaid=unpaid), gamma=0.99)
    falling = lambda left: 1e-3 * left  # noqa: E731
    model = PPO("MlpPolicy", trained, falling, 64, 1024, gae_lambda=0.97, seed=seed, device="cpu").learn(steps)
    acts = lambda seen: model.predict(trained.normalize_obs(seen), deterministic=True)[0]  # noqa: E731
    plant = Guarded(machine, REFERENCE_EPISODES, seed + 1)
    earned, left, fallbacks = _in_lanes(plant, acts)
    share = float(fallbacks.mean()) / plant.plant.time_limit
    return float(earned.mean()), int(left.sum()), REFERENCE_EPISODES, int((fallbacks > 0).sum()), share


def _in_lanes(plant: Guarded, acts: Predict) -> tuple[Array, Array, Array]:
    """Return the return, whether a limit was left, and the number of fallbacks of one episode in each lane, (N,)
    each."""
    seen = plant.reset()
    found = plant.earned, plant.left, plant.fallbacks
    for _ in range(plant.plant.time_limit):
        plant.step_async(acts(seen))
        seen, *_ = plant.step_wait()
    return found


def random_episodes(machine: str, seed: int, episodes: int, *, limited: bool) -> tuple[int, int, float]:
    """Take whole episodes of random actions. Return the number of those that left the physical limit, their number, and
    the share of steps in which the fallback acted."""
    plant, rng = PLANTS[machine], np.random.default_rng([seed, 7])
    kept, free = specifications(plant, seed)
    judged, spec = _judging(plant, kept), kept if limited else free
    environment = open_episode("plant:Plant", spec, lambda: Respecified(plant.make(seed), spec))
    low, high = np.array(spec.action.ranges).T
    left = steps = fallbacks = 0
    for _ in range(episodes):
        moment, path, held = environment.reset(int(rng.integers(2**31))), [], int(rng.choice((1, 2, 4, 8)))
        for number in range(spec.time_limit or 0):
            if number % held == 0:
                extreme = rng.random(len(low)) < 0.7
                action = np.where(extreme, rng.choice((low, high)), rng.uniform(low, high))
            moment = environment.step(action)
            path.append(moment.coordinates)
            fallbacks += moment.fell_back
            if moment.terminated or moment.truncated:
                break
        steps += len(path)
        left += bool(past(judged, np.array(path)).any())
    return left, episodes, fallbacks / steps


def guard_times(machine: str) -> tuple[float, float]:
    """Median and 99th percentile of the milliseconds that the guard takes in a step, at random states."""
    spec, _ = specifications(PLANTS[machine], 0)
    low, high = np.array([limits(c.sampling) for c in spec.coordinates]).T
    states = np.random.default_rng(0).uniform(low, high, (20_000, len(low)))
    guard, action, times = Guard(spec), np.zeros(spec.action.size), []
    guard.begin(states[0])
    for state in states:
        begun = time.perf_counter()
        guard.choose(action)
        guard.reached(state)
        times.append(1e3 * (time.perf_counter() - begun))
    median, late = np.quantile(times, [0.5, 0.99]).tolist()
    return median, late


def specifications(plant: Plant, seed: int) -> tuple[EnvironmentSpec, EnvironmentSpec]:
    """Specifications with the limits, and without."""
    own = plant.make(seed).spec()
    fields = {**own.model_dump(), "query": "rollout", "sampling_period": plant.period, **plant.changes}
    fields["design"] = {**fields["design"], "seed": seed, "budget": plant.budget, "initial": None}
    free = EnvironmentSpec.model_validate(fields)
    return EnvironmentSpec.model_validate({**fields, "limits": plant.limits.model_dump()}), free


def _judging(plant: Plant, spec: EnvironmentSpec) -> EnvironmentSpec:
    """Specification whose only limit is the physical one."""
    limits = plant.limits.model_copy(update={"keep": (plant.physical,)})
    judging: EnvironmentSpec = EnvironmentSpec.model_validate({**spec.model_dump(), "limits": limits.model_dump()})
    return judging


def run(machine: str, seed: int, options: argparse.Namespace, *, limited: bool) -> Row:
    plant = PLANTS[machine]
    kept, free = specifications(plant, seed)
    spec = kept if limited else free
    judged = _judging(plant, kept)

    def made() -> Any:
        return Respecified(plant.make(seed), spec)

    environment: Any = keeping_limits(answering(made()))
    design = surrogym.Design(spec, threads=1)
    rollouts = left = 0
    while (query := design.ask()) is not None:
        state = environment.begin(int(np.random.SeedSequence([seed, query.id]).generate_state(1)[0]))
        steps, acting = [], design.acting(query)
        for number in range(len(query.actions)):
            steps.append(environment.act(np.array(acting(number, state))))
            state = np.array(steps[-1].next_coordinates)
            if steps[-1].terminated or steps[-1].truncated:
                break
        design.tell(query, steps)
        rollouts += 1
        left += bool(past(judged, np.array([step.next_coordinates for step in steps])).any())
    so_far = machine, limited, seed, design.phase, design.steps, rollouts, left
    if options.no_policy:
        return Row(*so_far, float("nan"), 0, 0, float("nan"), 0, float("nan"), 0)
    model = design.surrogate()
    acts = model.planner(options.horizon or horizon_of(spec), seed) if options.planner else _trained(model, seed)
    if options.shares:
        print_shares(machine, model, acts, seed, options.episodes)
    earned, violated, fallbacks = _episodes(machine, spec, acts, seed, options.episodes)
    fallback = promise_of(model, acts, seed).fallback
    elsewhere = _episodes(machine, spec, acts, seed, options.episodes, changed=True)[1]
    return Row(
        *so_far,
        float(earned.mean()),
        len(earned),
        int(violated.sum()),
        float(fallbacks.mean()) / (spec.time_limit or 1),
        int((fallbacks > 0).sum()),
        float("nan") if fallback is None or fallback.mean is None else fallback.mean,
        int(elsewhere.sum()),
    )


def print_shares(machine: str, model: LocalSurrogate, acts: Predict, seed: int, episodes: int) -> None:
    """Print for several sizes of the physical limit, without a margin, in how many episodes of a policy the fallback is
    expected, in how many real ones it acts, and how many leave the limit without a guard."""
    plant = PLANTS[machine]
    for scale in SCALES:
        moved = {end: scale * at for end in ("low", "high") if (at := getattr(plant.physical, end)) is not None}
        limits = plant.limits.model_copy(update={"keep": (plant.physical.model_copy(update=moved),)})
        spec = EnvironmentSpec.model_validate({**model.spec().model_dump(), "limits": limits.model_dump()})
        found = promise_of(LocalSurrogate.from_bytes(spec, model.model_file()), acts, seed).fallback
        left = _in_lanes(Guarded(machine, episodes, seed, guard=False, spec=spec), acts)[1].mean()
        fell_back = (_in_lanes(Guarded(machine, episodes, seed, spec=spec), acts)[2] > 0).mean()
        assert found is not None
        words = f"expected {found.mean:.2%} ({found.low:.2%} to {found.high:.2%}), real {fell_back:.2%}"
        print(f"{machine}, seed {seed}, limit times {scale:g}: fallback {words}; left without a guard {left:.2%}")


def _episodes(
    machine: str, spec: EnvironmentSpec, acts: Predict, seed: int, episodes: int, *, changed: bool = False
) -> tuple[Array, Array, Array]:
    """Return the return, whether the physical limit was left, and the number of fallbacks of each real episode. Those
    of formulas run side by side."""
    plant = PLANTS[machine]
    made = plant.changed if changed else plant.make
    if isinstance(made(seed), Formula):
        return _in_lanes(Guarded(machine, episodes, seed, guard=spec.limits is not None, changed=changed), acts)
    environment = open_episode("plant:Plant", spec, lambda: Respecified(made(seed), spec))
    judged, found = _judging(plant, specifications(plant, seed)[0]), np.zeros((episodes, 3))
    for number in range(episodes):
        moment = environment.reset(FIRST_SEED + number)
        path = [moment.coordinates]
        for _ in range(spec.time_limit or 0):
            moment = environment.step(acts(moment.observation[None].astype(np.float32))[0])
            path.append(moment.coordinates)
            found[number] += moment.reward, 0, moment.fell_back
            if moment.terminated or moment.truncated:
                break
        found[number, 1] = past(judged, np.array(path)).any()
    return found[:, 0], found[:, 1] > 0, found[:, 2]


def _trained(model: LocalSurrogate, seed: int) -> Predict:
    with TemporaryDirectory() as folder:
        trained = train(model, Path(folder) / "policy", TrainSettings(algorithm=SEARCH, seed=seed))
        return load_policy(trained.path, SEARCH)


def table(rows: Sequence[Row]) -> str:
    """Pooled counts of each machine, with exact upper 95 % bounds."""
    lines = [
        "| machine | limits | seeds | real steps | rollouts that left | return | episodes that left | with a fallback "
        "| expected | left in the changed machine |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for machine, limited in sorted({(row.machine, row.limits) for row in rows}):
        here = [row for row in rows if (row.machine, row.limits) == (machine, limited)]
        steps, values = [row.steps for row in here], [row.value for row in here]
        lines.append(
            f"| {machine} | {'yes' if limited else 'no'} | {len(here)} | {np.median(steps):g} "
            f"({min(steps)} to {max(steps)}) | {_share(sum(r.left for r in here), sum(r.rollouts for r in here))} | "
            f"{np.median(values):.4g} ({min(values):.4g} to {max(values):.4g}) | "
            f"{_share(sum(r.violations for r in here), sum(r.episodes for r in here))} | "
            f"{100 * sum(r.fell_back for r in here) / max(1, sum(r.episodes for r in here)):.2g} % | "
            f"{100 * np.mean([r.expected for r in here]):.2g} % | "
            f"{_share(sum(r.changed for r in here), sum(r.episodes for r in here))} |"
        )
    return "\n".join(lines)


def _share(count: int, of: int) -> str:
    if not of:
        return "-"
    high = binomtest(count, of, alternative="less").proportion_ci(0.95, method="exact").high
    return f"{count} of {of} (below {100 * high:.2g} %)"


def _options() -> argparse.Namespace:
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--machines", nargs="+", choices=list(PLANTS), default=list(PLANTS))
    made.add_argument("--first-seed", type=int, default=0)
    made.add_argument("--seeds", type=int, default=1)
    made.add_argument("--episodes", type=int, default=2_000, help="real episodes of each policy")
    made.add_argument("--shares", action="store_true", help="print expected and real shares for several limits")
    made.add_argument("--without-limits-only", action="store_true", help="no rows with limits")
    made.add_argument("--planner", action="store_true", help="policies are planners")
    made.add_argument("--horizon", type=int, help="steps of each rollout of the planner")
    made.add_argument("--random", type=int, metavar="EPISODES", help="only take episodes of random actions")
    made.add_argument("--reference", type=int, metavar="STEPS", help="only train by PPO in the plant for these steps")
    made.add_argument("--unpaid", action="store_true", help="its episodes earn nothing from a fallback on")
    made.add_argument("--time", action="store_true", help="only measure the time that the guard takes in a step")
    made.add_argument("--no-policy", action="store_true", help="designs alone")
    made.add_argument("--with-limits-only", action="store_true", help="no rows without limits")
    made.add_argument("--out", type=Path, default=OUT)
    return made.parse_args()


if __name__ == "__main__":
    main()
