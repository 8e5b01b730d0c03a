"""Whether noise of the sensors is told from noise of the process, where a machine can only be reset.

    python lab/benchmarks/sensor_noise.py tell --steps 60 --seeds 30 --first-seed 100
    python lab/benchmarks/sensor_noise.py design --machines mass --kinds sensor --seeds 5 --first-seed 100
    python lab/benchmarks/sensor_noise.py imagine --machines mass cart --seeds 5 --first-seed 200

``tell`` fits a model to random rollouts, and counts the outputs whose noise is found to be mainly the sensor's.
``design`` lets a design choose the rollouts. ``imagine`` compares the real return of a fixed feedback with that in the
model, with the noise left out, driving the state, and seen by the policy alone. Noise is given as a share of each
coordinate's range.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import numpy as np
import torch

from support.changing import MACHINES, Machine
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.samples import Samples
from surrogym_server.models.guard import learn
from surrogym_server.models.port import DynamicsModel
from surrogym_server.sampling.design import advance, initial_queries
from surrogym_server.sampling.rollouts import random_sequences
from surrogym_server.sampling.sensor_noise import SensorNoise, sensor_noise
from surrogym_server.sampling.state import DesignState, Request
from surrogym_server.sampling.tolerances import DefaultTolerances, frozen_tolerances
from surrogym_server.virtual import VirtualSettings, create, reset, step
from surrogym_shared.spec import Design

KINDS = {"none": (0.0, 0.0), "process": (0.01, 0.0), "sensor": (0.0, 0.01), "both": (0.007, 0.007)}
LOUD = 0.03  # noise of the sensors in ``imagine``
GAINS = {"mass": np.array([1.5, 0.8]), "cart": np.array([2.0, 1.0])}  # of the fixed feedback
LANES, REAL = 200, 2_000

Row = tuple[np.ndarray, np.ndarray, np.ndarray, float]


def of(machine: Machine, seed: int) -> EnvironmentDefinition:
    return definition_from_spec(machine.spec.model_copy(update={"query": "rollout", "design": Design(seed=seed)}))


def spans(machine: Machine) -> np.ndarray:
    return np.array([high - low for low, high in machine.ranges.values()])


def play(machine: Machine, actions: np.ndarray, noise: tuple[float, float], rng: np.random.Generator) -> list[Row]:
    """One rollout (T, F): measured states, actions, measured next states and rewards."""
    process, sensor = (share * spans(machine) for share in noise)
    low, high = np.array(list(machine.start.values())).T
    state = rng.uniform(low, high)
    seen, rows = state + sensor * rng.standard_normal(len(state)), []
    for u in actions:
        after, reward = machine.formula(state[None], np.clip(u, -1, 1)[None], machine.real)
        state = after[0] + process * rng.standard_normal(len(state))
        after_seen = state + sensor * rng.standard_normal(len(state))
        rows.append((seen, u, after_seen, float(reward[0])))
        seen = after_seen
    return rows


def samples_of(rows: list[Row]) -> Samples:
    q, u, q_next, reward = (torch.tensor(np.array(column), dtype=torch.float64) for column in zip(*rows, strict=True))
    return Samples(q, u, q_next, reward, torch.zeros(len(rows), dtype=torch.bool))


def random_model(
    machine: Machine, steps: int, length: int, noise: tuple[float, float], seed: int
) -> tuple[DynamicsModel, tuple[SensorNoise | None, ...]]:
    """A model of random rollouts, and what it tells."""
    definition, rng, rows = of(machine, 0), np.random.default_rng([seed, 5]), []
    while len(rows) < steps:
        actions = random_sequences(definition, 1, min(length, steps - len(rows)), rng)[0]
        rows += play(machine, actions, noise, rng)
    samples = samples_of(rows)
    model = learn(definition, samples, {}).model
    frozen = frozen_tolerances(definition, samples, DefaultTolerances()).values
    return model, sensor_noise(model, samples, definition.tolerances_or(frozen))


def tell(machine: Machine, given: argparse.Namespace) -> None:
    for kind in given.kinds:
        found = [random_model(machine, given.steps, 8, KINDS[kind], seed)[1][:-1] for seed in given.all_seeds]
        counts = [sum(one is not None for one in output) for output in zip(*found, strict=True)]
        print(f"{machine.name}, noise {kind}, {given.steps} steps: sensors found {counts} of {len(found)}", flush=True)


def design(machine: Machine, given: argparse.Namespace) -> None:
    for kind in given.kinds:
        for seed in given.all_seeds:
            definition, rng, state = of(machine, seed), np.random.default_rng([seed, 9]), DesignState()
            actions = [np.array(query.actions) for query in initial_queries(definition, given.budget)]
            rows: list[Row] = []
            while actions:
                rows += [row for one in actions for row in play(machine, one, KINDS[kind], rng)]
                samples = samples_of(rows)
                request = Request(given.budget, 0.999)
                decided = advance(definition, samples, state, request)
                state, actions = decided.state, [np.array(query.actions) for query in decided.queries]
            judged = decided.confidences
            words = [f"{c.confidence_index:.4f}, noise {c.noise:.3g}, sensor {c.sensor_noise:.3g}" for c in judged]
            print(
                f"{machine.name}, noise {kind}, seed {seed}: {decided.verdict}, {len(rows)} steps; {words}", flush=True
            )


def imagine(machine: Machine, given: argparse.Namespace) -> None:
    for seed in given.all_seeds:
        model, found = random_model(machine, 100, 10, (0.0, LOUD), seed)
        sensors = tuple((name, one.std) for name, one in zip(machine.ranges, found, strict=False) if one)
        noisy = {"process_noise": True}
        cases = {"left out": {}, "drives the state": noisy, "seen alone": {**noisy, "sensor_noise": sensors}}
        words = [f"{name} {_imagined(machine, model, seed, chosen):.1f}" for name, chosen in cases.items()]
        print(f"{machine.name}, seed {seed}: real {_real(machine, seed):.1f}; {', '.join(words)}", flush=True)


def _acts(machine: Machine, seen: np.ndarray) -> np.ndarray:
    return np.clip(-(seen @ GAINS[machine.name]), -1, 1)[:, None]


def _real(machine: Machine, seed: int) -> float:
    rng, (low, high) = np.random.default_rng([seed, 6]), np.array(list(machine.start.values())).T
    state, total = rng.uniform(low, high, (REAL, len(low))), 0.0
    for _ in range(machine.time_limit):
        seen = state + LOUD * spans(machine) * rng.standard_normal(state.shape)
        state, reward = machine.formula(state, _acts(machine, seen), machine.real)
        total += float(reward.mean())
    return total


def _imagined(machine: Machine, model: DynamicsModel, seed: int, chosen: dict) -> float:
    settings = VirtualSettings(LANES, "pathwise", "disabled", functions=8, time_limit=machine.time_limit, **chosen)
    lanes, seen = reset(model.definition, settings, create(model.definition, settings, seed))
    total = 0.0
    for _ in range(machine.time_limit):
        lanes, moved = step(model, settings, lanes, _acts(machine, seen.astype(float)))
        seen, total = moved.observation, total + float(moved.reward.mean())
    return total


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("tell", "design", "imagine"))
    parser.add_argument("--machines", nargs="+", default=["mass", "cart", "arm", "pole"])
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--steps", type=int, default=60, help="random steps of tell")
    parser.add_argument("--budget", type=int, default=80, help="real steps of design")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first-seed", type=int, default=100)
    given = parser.parse_args()
    given.all_seeds = range(given.first_seed, given.first_seed + given.seeds)
    torch.set_num_threads(1)
    for machine in MACHINES:
        if machine.name in given.machines:
            {"tell": tell, "design": design, "imagine": imagine}[given.part](machine, given)


if __name__ == "__main__":
    main()
