"""The first region that is known to keep a limit: rollouts that a model allows after few real steps, with and without a
prior.

A cart-pole swing-up on a rail, whose parameters are off as in ``bench_priors.py``, takes a few random steps from
resets. A model is learned from them alone, and one beside a calibrated simulator without friction. Of 400 other random
action sequences from resets, a row has the share of steps that the design may plan (before a limit could be left with
more than 1 %), and the share of the planned sequences that leave the limit in the plant.

    python lab/benchmarks/bench_first_region.py --seeds 1049 1050 1051 1052 --steps 10 20 40
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
import torch
from bench_priors import TASKS, scaled

import surrogym
from surrogym_sampler import original
from surrogym_sampler.original.protocol import RealStep
from surrogym_sampler.priors.calibration import adjustable
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.samples import Samples
from surrogym_server.models.files import from_bytes
from surrogym_server.models.gaussian_process.family import GaussianProcesses
from surrogym_server.sampling.rollouts import predict_paths, random_sequences, start_points
from surrogym_shared.nouns import RealSteps
from surrogym_shared.spec import EnvironmentSpec, Limit, Limits, Term

SEQUENCES, LENGTH, OFF = 400, 30, 0.3
RAIL = Limits(
    keep=(Limit(name="rail", term=Term.linear(x=1, velocity=0.3), low=-4, high=4, margin=0.5),),
    fallback=(Term.linear(x=-3, velocity=-6),),
    probability=0.01,
)


def main() -> None:
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--seeds", nargs="+", type=int, required=True)
    made.add_argument("--steps", nargs="+", type=int, default=[10, 20, 40])
    options = made.parse_args()
    torch.set_num_threads(1)
    for seed in options.seeds:
        run(seed, options.steps)


def run(seed: int, counts: list[int]) -> None:
    name, names, _ = TASKS["swingup"]
    rng = np.random.default_rng([seed, 77])
    plant = scaled(original.make(name), names, rng.uniform(1 - OFF, 1 + OFF, len(names)))
    limits = {"limits": RAIL.model_dump(), "query": "rollout"}
    definition = definition_from_spec(EnvironmentSpec.model_validate({**plant.spec().model_dump(), **limits}))
    simulator: Any = original.make(name)
    adjustable(simulator).set_parameters({"friction": 0.0})
    family = GaussianProcesses()
    real = random_steps(definition, plant, max(counts), rng)
    starts = start_points(definition, SEQUENCES, rng)
    actions = torch.from_numpy(random_sequences(definition, SEQUENCES, LENGTH, rng))
    for count in counts:
        samples = Samples.of(RealSteps.of(real[:count], "manual"))
        prior = surrogym.Prior(simulator, plant.spec(), [one for one in names if one != "friction"])
        prior.calibrate(real[:count])
        known = from_bytes(definition, prior.learned()[0].model)
        fits = {"cold": family.learn(definition, samples), "prior": family.learn_beside(known, definition, samples)}
        for words, fit in fits.items():
            running = predict_paths(fit.model, starts, actions).running
            left = [leaves(plant, *row) for row in zip(starts, actions, running.sum(1).long(), strict=True)]
            print(
                f"{seed}, {count:2} real steps, {words:5}: {running.mean():.0%} of the steps may be planned; "
                f"{sum(left)} of {SEQUENCES} sequences leave the limit in the plant",
                flush=True,
            )


def random_steps(definition: Any, plant: Any, count: int, rng: np.random.Generator) -> list[RealStep]:
    """Random rollouts of ten steps from resets."""
    steps: list[RealStep] = []
    while len(steps) < count:
        q = start_points(definition, 1, rng)[0].numpy()
        for u in random_sequences(definition, 1, 10, rng)[0]:
            steps.append(plant.step_from(q, u))
            q = np.asarray(steps[-1].next_coordinates)
    return steps[:count]


def leaves(plant: Any, start: torch.Tensor, actions: torch.Tensor, length: torch.Tensor) -> bool:
    q = start.numpy()
    for u in actions[: int(length)].numpy():
        q = np.asarray(plant.step_from(q, u).next_coordinates)
        if abs(q[0] + 0.3 * q[1]) > 4:
            return True
    return False


if __name__ == "__main__":
    main()
