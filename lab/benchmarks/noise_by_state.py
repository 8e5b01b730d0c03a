"""How well leave-one-out errors show that noise depends on the state.

    python lab/benchmarks/noise_by_state.py --seeds 30 --first-seed 300

The mass is set to random states. The deviation of its process noise is 1 % of each range on average, and grows with
the speed from s to ``ratio`` times s. The logarithms of the squared standardised leave-one-out errors are regressed on
the sizes of coordinates and action. If the noise is the same everywhere, they have the variance pi^2 / 2, and the
explained sum of squares over it is chi-squared with one degree of freedom for each of them. The level is 1 %.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import numpy as np
import scipy
import torch

from support.changing import MACHINES, Machine
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.samples import Samples
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.models.guard import learn

NOISE, LEVEL = 0.01, 0.01
RATIOS = (1.0, 3.0, 10.0)  # of the noise at the largest speed over that at rest
COUNTS = (30, 60, 120)


def sampled(machine: Machine, count: int, ratio: float, rng: np.random.Generator) -> Samples:
    low, high = np.array(list(machine.ranges.values())).T
    q, u = rng.uniform(low, high, (count, len(low))), rng.uniform(-1, 1, (count, 1))
    after, reward = machine.formula(q, u, machine.real)
    shape = 1 + (ratio - 1) * np.abs(q[:, 1:]) / high[1]
    after = after + NOISE * (high - low) * shape / shape.mean() * rng.standard_normal(q.shape)
    arrays = [torch.from_numpy(a) for a in (q, u, after, reward)]
    return Samples(*arrays, torch.zeros(count, dtype=torch.bool))


def detected(model: GaussianProcessModel, samples: Samples) -> list[bool]:
    """Whether each transition output's noise is found to depend on the state."""
    sizes = torch.cat([samples.q, samples.u], 1).abs().numpy()
    sizes = sizes - sizes.mean(0)
    found = []
    for output in model.transitions:
        assert output.posterior is not None
        mean, variance = output.posterior.leave_one_out()
        logs = ((output.posterior.y - mean).square() / variance).log().numpy()
        explained = sizes @ np.linalg.lstsq(sizes, logs - logs.mean(), rcond=None)[0]
        statistic = float((explained**2).sum() / (np.pi**2 / 2))
        found.append(statistic > scipy.stats.chi2.isf(LEVEL, sizes.shape[1]))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=30)
    parser.add_argument("--first-seed", type=int, default=300)
    given = parser.parse_args()
    torch.set_num_threads(1)
    machine = next(one for one in MACHINES if one.name == "mass")
    definition = definition_from_spec(machine.spec)
    for count in COUNTS:
        for ratio in RATIOS:
            found: list[bool] = []
            for seed in range(given.first_seed, given.first_seed + given.seeds):
                samples = sampled(machine, count, ratio, np.random.default_rng([seed, count]))
                model = learn(definition, samples, {}).model
                assert isinstance(model, GaussianProcessModel)
                found += detected(model, samples)
            print(f"{count} samples, ratio {ratio:g}: found in {sum(found)} of {len(found)} outputs", flush=True)


if __name__ == "__main__":
    main()
