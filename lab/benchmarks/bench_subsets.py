"""A model of all rows of a log beside exact ones of random subsets: errors of one step on episodes left out.

python lab/benchmarks/bench_subsets.py --rows 5000 --subsets 20

The log is the reactor's of the examples. Errors are root mean squares of the next states, each in deviations of its
increments there. "anywhere" is uniform over the sampling range instead, where the log may never have been.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import numpy as np
import torch
from common import parser, started, write

from support.models import gaussian_processes
from support.reactor import example
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.samples import Samples, increments

LENGTH, LEFT_OUT, ANYWHERE = 100, 20, 2_000  # rows of an episode, episodes left out, points anywhere


def samples_of(rows: Any) -> Samples:
    """Rows of the example's log as samples."""
    table = torch.tensor(np.array(list(rows)), dtype=torch.float64)
    return Samples(table[:, 2:4], table[:, 4:5], table[:, 6:8], table[:, 5], torch.zeros(len(table), dtype=torch.bool))


def anywhere(module: Any) -> Samples:
    """Steps from anywhere in the sampling range."""
    rng, rows = np.random.default_rng(7), []
    for _ in range(ANYWHERE):
        state, coolant = (
            (float(rng.uniform(0, 1)), float(rng.uniform(300, module.RELIEF))),
            float(rng.uniform(280, 320)),
        )
        rows.append((0, 0, *state, coolant, module.pay(state, coolant), *module.advance(state, coolant)))
    return samples_of(rows)


def errors(definition: EnvironmentDefinition, samples: Samples, tests: dict[str, Samples]) -> dict[str, Any]:
    """Of a model of these samples: root mean square and largest error in each test, and seconds of the fit."""
    begun = time.perf_counter()
    model = gaussian_processes(definition, samples)
    found: dict[str, Any] = {"samples": len(samples), "seconds": round(time.perf_counter() - begun, 1)}
    for name, test in tests.items():
        off = (model.transition(test.q, test.u).q_next - test.q_next) / increments(definition, test).std(0)
        found[name] = {"rms": off.square().mean(0).sqrt().tolist(), "largest": off.abs().amax(0).tolist()}
    found["structures"] = [
        f"{one}, {'exact' if o.posterior is None or o.posterior.sparse is None else 'sparse'}"
        for one, o in zip(model.structures, model.outputs, strict=True)
    ]
    return found


def main() -> None:
    made = parser(__doc__)
    made.add_argument("--rows", type=int, default=5_000)
    made.add_argument("--subsets", type=int, default=20)
    made.add_argument("--size", type=int, default=300, help="rows of a subset")
    made.add_argument("--log", type=int, default=0, help="seed of the log; the episodes left out have the next one")
    made.add_argument("--first", type=int, default=0, help="a model of so many first rows as well; 0: none")
    options = started(made)
    module = example()
    definition = definition_from_spec(module.Reactor().spec())
    log = samples_of(module.operate(options.rows // LENGTH, LENGTH, seed=options.log))
    tests = {
        "left out": samples_of(module.operate(LEFT_OUT, LENGTH, seed=options.log + 1)),
        "anywhere": anywhere(module),
    }
    report: dict[str, Any] = {"rows": options.rows, "all": errors(definition, log, tests)}
    print("all", report["all"])
    if options.first:
        report["first"] = errors(definition, chosen(log, torch.arange(options.first)), tests)
        print("first", report["first"])
    report["subsets"] = []
    for seed in range(options.subsets):
        rows = torch.from_numpy(np.random.default_rng(seed).choice(len(log), options.size, replace=False))
        report["subsets"].append(errors(definition, chosen(log, rows), tests))
        print("subset", seed, report["subsets"][-1])
    write(options.out, f"subsets-{options.rows}", report)


def chosen(samples: Samples, rows: torch.Tensor) -> Samples:
    return Samples(*(getattr(samples, name)[rows] for name in Samples.__dataclass_fields__))


if __name__ == "__main__":
    main()
