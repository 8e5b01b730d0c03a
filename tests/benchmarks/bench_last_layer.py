"""Guards of a Bayesian last layer against false certainty: on which features it stands, and how many networks.

python tests/benchmarks/bench_last_layer.py

Each task is a function of two inputs, given at ``--rows`` random points; the targets of ``noisy`` have 5 % noise.
Three tasks are smooth, and two have kinks or jumps. Inside are test points of the same distribution, outside those at
1.2 to 2 times its range. For each variant the table has inside and outside: error in deviations of the function, mean
log density of a normal distribution in nats (at least -10 a point, deviations at least 1 %), and the share inside 90 %
intervals. All of these are of the function, without noise. ``grows`` is the median deviation outside as a multiple of
that inside. The time is processor time of a fit.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable

import torch
from common import parser, started, write
from torch import Tensor

from surrogym_server.models.bayesian_last_layer.training import Training, train

TESTS, EDGE = 500, 3**0.5
FLOOR, WORST, LEVEL = 0.01, -10.0, 1.6449
Task = Callable[[Tensor], Tensor]
TASKS: dict[str, Task] = {
    "sine": lambda x: torch.sin(1.5 * x[:, 0]) + 0.3 * x[:, 1],
    "product": lambda x: x[:, 0] * torch.cos(x[:, 1]),
    "noisy": lambda x: torch.sin(2 * x[:, 0]) * torch.exp(-0.3 * x[:, 1]),
    "kink": lambda x: (x[:, 0] + 0.5 * x[:, 1]).abs() - 0.5 * x[:, 1].clamp_min(0.3),
    "bounce": lambda x: torch.where((x[:, 0] + 0.4 * x[:, 1]).abs() > 1.5, -1.8 * x[:, 1], 0.1 * x[:, 0]),
}
NOISE = {"noisy": 0.05}
SMOOTH = ("sine", "product", "noisy")
VARIANTS: dict[str, tuple[int, int, float]] = {  # members, waves, freedom
    "plain": (1, 0, math.inf),
    "prior": (1, 0, 0.1),
    "prior, waves": (1, 64, 0.1),
    "4 networks": (4, 0, 0.1),
    "4 networks, waves": (4, 64, 0.1),
    "the same, freedom 1": (4, 64, 1.0),
    "the same, no prior": (4, 64, math.inf),
    "the same, not trained": (4, 64, 1e-9),
}


def measured(task: str, rows: int, seed: int, variant: str, steps: int) -> dict[str, float]:
    members, waves, freedom = VARIANTS[variant]
    generator = torch.Generator().manual_seed(seed)

    def uniform(count: int) -> Tensor:
        return EDGE * (2 * torch.rand(count, 2, generator=generator, dtype=torch.float64) - 1)

    x, inside = uniform(rows), uniform(TESTS)
    outside = uniform(TESTS)
    outside = (
        outside
        / outside.abs().amax(1, keepdim=True)
        * EDGE
        * (1.2 + 0.8 * torch.rand(TESTS, 1, generator=generator, dtype=torch.float64))
    )
    y = TASKS[task](x)
    y = y + NOISE.get(task, 0.0) * y.std() * torch.randn(rows, generator=generator, dtype=torch.float64)
    centre, scale = y.mean(), y.std(correction=0)
    begun = time.process_time()
    training = Training(members, 32, waves, steps, seed, freedom)
    fitted = train(training, x, ((y - centre) / scale)[:, None]).regression
    noise = float(fitted.noise_deviation[0])
    found, widths = {"seconds": time.process_time() - begun, "noise": noise}, []
    for name, points in (("inside", inside), ("outside", outside)):
        phi = fitted.phi(points)
        mean, spread = fitted.members_means(phi).mean(0)[:, 0], fitted.deviation(phi)[:, 0]
        error = mean - (TASKS[task](points) - centre) / scale
        deviation = (spread.square() + FLOOR**2).sqrt()
        density = torch.distributions.Normal(0.0, deviation).log_prob(error).clamp_min(WORST)
        widths.append(float(spread.median()))
        found |= {
            f"error {name}": float(error.square().mean().sqrt()),
            f"density {name}": float(density.mean()),
            f"covered {name}": float((error.abs() <= LEVEL * deviation).double().mean()),
        }
    return found | {"grows": widths[1] / max(widths[0], 1e-9)}


def options() -> argparse.Namespace:
    made = parser(__doc__)
    made.add_argument("--tasks", choices=TASKS, nargs="*", default=list(TASKS))
    made.add_argument("--variants", choices=VARIANTS, nargs="*", default=list(VARIANTS))
    made.add_argument("--rows", type=int, nargs="*", default=[20, 150])
    made.add_argument("--seeds", type=int, nargs="*", default=[0, 1, 2])
    made.add_argument("--steps", type=int, default=300)
    return started(made)


def main() -> None:
    given = options()
    report = []
    names = (
        "error inside",
        "density inside",
        "covered inside",
        "error outside",
        "density outside",
        "covered outside",
        "grows",
        "noise",
        "seconds",
    )
    for rows in given.rows:
        for task in given.tasks:
            print(f"{task}, {rows} rows: {', '.join(names)}")
            for variant in given.variants:
                runs = [measured(task, rows, seed, variant, given.steps) for seed in given.seeds]
                mean = {name: sum(run[name] for run in runs) / len(runs) for name in names}
                report.append({"task": task, "rows": rows, "variant": variant, "runs": runs, "mean": mean})
                print(f"  {variant:22}" + "".join(f"{mean[name]:9.3f}" for name in names))
    write(given.out, "last_layer", {"rows": report})


if __name__ == "__main__":
    main()
