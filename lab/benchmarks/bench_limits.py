"""Errors of one step of the reactor, learned with and without samples that ended at its relief valve.

python lab/benchmarks/bench_limits.py --seeds 0 1 2
python lab/benchmarks/bench_limits.py --seeds 300 301 302 303 304 --designs
python lab/benchmarks/bench_limits.py --seeds 0 1 2 --two-sided

Models are learned from Latin hypercubes in three ways: ``without`` samples at the valve, with those at the limit ``of
others``, and with ``inequalities`` at an output's own limit as well. Errors are root mean squares of the next states in
deviations of a step, on steps from anywhere in the range, on those of them that end below the valve, and on a log's.
The fourth way, ``no rates``, has the samples of the third, and outputs without rates (see ``gp.growth``). With
``--designs`` the models are those of whole designs of 100 real steps, without a policy: adaptive ones in three of these
ways, and a hypercube. With ``--two-sided`` both coordinates have two limits, as a log's mapping declares them.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import numpy as np
import torch
from bench_subsets import samples_of
from common import parser, started, write
from torch import Tensor

from support.models import gaussian_processes
from support.reactor import MAPPING, example
from support.real_steps import arrays, join
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.samples import Samples, increments, saturated
from surrogym_server.models.gaussian_process.learning import learn as learning
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel
from surrogym_server.sampling.design import advance, initial_queries
from surrogym_server.sampling.latin_hypercube import latin_hypercube
from surrogym_server.sampling.state import DesignState, Request
from surrogym_shared.spec import Bounds, Design, EnvironmentSpec

SIZES, UNSEEN, EPISODES, LENGTH, BUDGET = (12, 24, 50, 100), 1_500, 10, 100, 100
REACTOR = example()
PAST_LIMITS, WITHIN_LIMITS = learning.past_limits, learning.within_limits


def unchanged(_: Any, output: OutputModel, *_others: Any) -> OutputModel:
    """The output without such samples."""
    return output


WAYS = {
    "without": (unchanged, unchanged),
    "of others": (PAST_LIMITS, unchanged),
    "inequalities": (PAST_LIMITS, WITHIN_LIMITS),
    "no rates": (PAST_LIMITS, WITHIN_LIMITS),
}


def bounded(spec: EnvironmentSpec) -> EnvironmentSpec:
    """The reactor with two limits for each coordinate."""
    limits = [Bounds(**dict(zip(("low", "high"), MAPPING["limits"][name], strict=True))) for name in ("c", "T")]
    made = (c.model_copy(update={"bounds": b}) for c, b in zip(spec.coordinates, limits, strict=True))
    return spec.model_copy(update={"coordinates": tuple(made)})


def learn_by(
    spec: EnvironmentSpec, way: str, acquisition: str = "integrated_variance", seed: int = 0
) -> EnvironmentDefinition:
    """Learn in that way from now on. Returns the environment with a design."""
    learning.past_limits, learning.within_limits = WAYS[way]
    model = {"name": "gaussian_process", "settings": {"rates": way != "no rates"}}
    design = Design.model_validate({"acquisition": acquisition, "seed": seed, "model": model})
    return definition_from_spec(spec.model_copy(update={"design": design}))


def main() -> None:
    made = parser(__doc__)
    made.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    made.add_argument("--designs", action="store_true", help="models of whole designs instead of hypercubes")
    made.add_argument("--two-sided", action="store_true", help="two limits for each coordinate")
    options = started(made)
    spec = REACTOR.Reactor().spec()
    spec = bounded(spec) if options.two_sided else spec
    definition = definition_from_spec(spec)
    anywhere = steps(*hypercube(definition, UNSEEN, 99))
    below = ~saturated(definition, anywhere.q_next)
    tests = {
        "anywhere": anywhere,
        "below": Samples(*(getattr(anywhere, name)[below] for name in Samples.__dataclass_fields__)),
        "log": samples_of(REACTOR.operate(EPISODES, LENGTH, seed=1)),
    }
    rows = []
    for case, model, samples in (designed if options.designs else learned)(spec, options.seeds):
        row = {**case, "samples": len(samples), "below_valve": int((~saturated(definition, samples.q_next)).sum())}
        for where, test in tests.items():
            off = model.transition(test.q, test.u).q_next - test.q_next
            row[where] = (off.square().mean(0).sqrt() / increments(definition, anywhere).std(0)).tolist()
        rows.append(row)
        print({k: np.round(v, 3).tolist() if isinstance(v, list) else v for k, v in row.items()}, flush=True)
    write(options.out, "limits", {"rows": rows})


def steps(q: Tensor, u: Tensor) -> Samples:
    """One real step from each of q (n, 2) under u (n, 1)."""
    return samples_of(
        (0, 0, *a, b, REACTOR.pay(a, b), *REACTOR.advance(tuple(a), b))
        for a, (b,) in zip(q.tolist(), u.tolist(), strict=True)
    )


def hypercube(definition: EnvironmentDefinition, count: int, seed: int) -> tuple[Tensor, Tensor]:
    return latin_hypercube(definition, count, np.random.default_rng(seed))


def learned(spec: EnvironmentSpec, seeds: list[int]) -> Iterator[tuple[dict[str, Any], GaussianProcessModel, Samples]]:
    """Models of hypercubes."""
    for size in SIZES:
        for seed in seeds:
            samples = steps(*hypercube(learn_by(spec, "inequalities"), size, seed))
            for way in WAYS:
                yield {"seed": seed, "with": way}, gaussian_processes(learn_by(spec, way), samples), samples


def designed(spec: EnvironmentSpec, seeds: list[int]) -> Iterator[tuple[dict[str, Any], GaussianProcessModel, Samples]]:
    """Models of whole designs."""
    for seed in seeds:
        for way, acquisition in (
            ("of others", "integrated_variance"),
            ("no rates", "integrated_variance"),
            ("inequalities", "integrated_variance"),
            ("inequalities", "latin_hypercube"),
        ):
            definition = learn_by(spec, way, acquisition, seed)
            samples, state = steps(*arrays(initial_queries(definition, BUDGET))), DesignState()
            while len((made := advance(definition, samples, state, Request(BUDGET, 0.999))).queries):
                samples, state = join(samples, steps(*arrays(made.queries))), made.state
            model = made.model
            assert isinstance(model, GaussianProcessModel)
            yield {"seed": seed, "with": way, "acquisition": acquisition}, model, samples


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
