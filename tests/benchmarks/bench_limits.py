"""Errors of one step of the reactor, learned with and without samples that ended at its relief valve.

python tests/benchmarks/bench_limits.py --seeds 3

Models are learned from Latin hypercubes. Errors are root mean squares of the next states in deviations of a step, on
steps from anywhere in the range and on a log's.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
from bench_subsets import samples_of
from common import parser, started, write

from support.models import gaussian_processes
from support.reactor import example
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.samples import Samples, increments
from surrogym_server.models.gaussian_process.learning import learn as learning
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel
from surrogym_server.sampling.latin_hypercube import latin_hypercube

SIZES, UNSEEN, EPISODES, LENGTH = (12, 24, 50, 100), 1_500, 10, 100


def without(_: Any, output: OutputModel, *_others: Any) -> OutputModel:
    """The output without such samples."""
    return output


def main() -> None:
    made = parser(__doc__)
    made.add_argument("--seeds", type=int, default=3)
    options = started(made)
    module, chosen, rows = example(), learning.past_limits, list[dict[str, Any]]()
    definition = definition_from_spec(module.Reactor().spec())

    def steps(count: int, seed: int) -> Samples:
        q, u = (points.tolist() for points in latin_hypercube(definition, count, np.random.default_rng(seed)))
        return samples_of(
            (0, 0, *a, b, module.pay(a, b), *module.advance(tuple(a), b)) for a, (b,) in zip(q, u, strict=True)
        )

    tests = {"anywhere": steps(UNSEEN, 99), "log": samples_of(module.operate(EPISODES, LENGTH, seed=1))}
    for size in SIZES:
        for seed in range(options.seeds):
            samples = steps(size, seed)
            for name, choice in (("before", without), ("after", chosen)):
                learning.past_limits = choice
                model, row = gaussian_processes(definition, samples), {"samples": size, "seed": seed, "with": name}
                for where, test in tests.items():
                    off = model.transition(test.q, test.u).q_next - test.q_next
                    row[where] = (off.square().mean(0).sqrt() / increments(definition, test).std(0)).tolist()
                rows.append(row)
                print(row)
    write(options.out, "limits", {"rows": rows})


if __name__ == "__main__":
    main()
