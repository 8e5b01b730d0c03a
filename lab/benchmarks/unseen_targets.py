"""What the ten unseen tasks pay without any action, and what a policy earns that CMA-ES learns on the task itself.

The targets in ``surrogym_lab.tasks`` are four fifths of the way from the one to the other. No surrogate
is made here: python lab/benchmarks/unseen_targets.py
"""

from __future__ import annotations

import sys

import numpy as np
from cmaes import SepCMA

from surrogym_lab.tasks import UNSEEN
from surrogym_lab.unseen.machine import Machine
from surrogym_lab.unseen.tasks import ResetOnly
from surrogym_sampler.original.factories import load_factory
from surrogym_shared.network import Network
from surrogym_shared.terms import observe

UNITS, POPULATION, STARTS, GENERATIONS = 16, 32, 16, 300
SHARE = 0.8  # of the way from no action to the best


def main() -> None:
    for name in sys.argv[1:] or UNSEEN:
        machine = load_factory(UNSEEN[name].environment)()
        machine = machine._plate if isinstance(machine, ResetOnly) else machine
        idle = float(returns(machine, None, np.random.default_rng(1), 200).mean())
        best = max(oracle(machine, seed) for seed in range(2))
        print(f"{name}: idle {idle:.4g}, best {best:.4g}, target {idle + SHARE * (best - idle):.4g}", flush=True)


def oracle(machine: Machine, seed: int) -> float:
    """Mean real return of the best policy of one search, over 200 starts."""
    spec, rng = machine.spec(), np.random.default_rng([seed, 2])
    mean, deviation = statistics(machine, rng)
    search = SepCMA(np.zeros(Network.size(spec, UNITS)), 0.5, population_size=POPULATION, seed=seed)
    for generation in range(GENERATIONS):
        drawn = [search.ask() for _ in range(POPULATION)]
        policy = Network.of(spec, mean, deviation, UNITS, np.stack(drawn))
        starts = np.random.default_rng([seed, generation])
        earned = returns(machine, policy, starts, STARTS, POPULATION).reshape(POPULATION, STARTS).mean(1)
        search.tell([(x, -float(score)) for x, score in zip(drawn, earned, strict=True)])
    kept = Network.of(spec, mean, deviation, UNITS, np.array(search.mean)[None])
    return float(returns(machine, kept, np.random.default_rng(1), 200).mean())


def statistics(machine: Machine, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Mean and deviation of observations over the sampling range."""
    low, high = np.array(list(machine.ranges.values())).T
    shown = observe(machine.spec(), rng.uniform(low, high, (500, len(low))))
    return shown.mean(0), shown.std(0)


def returns(
    machine: Machine, policy: Network | None, rng: np.random.Generator, starts: int, population: int = 1
) -> np.ndarray:
    """Returns of each policy of a population from the same starts, in the order of policies."""
    spec, (low, high) = machine.spec(), np.array(list(machine.start.values())).T
    q = np.tile(rng.uniform(low, high, (starts, len(low))), (population, 1))
    spans = np.array([high - low for low, high in machine.ranges.values()])
    total = np.zeros(len(q))
    for _ in range(machine.time_limit):
        shown = observe(spec, q + machine.sensor_noise * spans * rng.standard_normal(q.shape)).astype(np.float32)
        u = np.zeros((len(q), machine.actions))
        if policy is not None:
            u = np.asarray(policy(shown.reshape(population, starts, -1)), dtype=float).reshape(u.shape)
        q, reward = machine.formula(q, np.clip(u, -1, 1))
        q = q + machine.process_noise * spans * rng.standard_normal(q.shape)
        total += reward
    return total


if __name__ == "__main__":
    main()
