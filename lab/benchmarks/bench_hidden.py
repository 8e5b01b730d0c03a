"""A reward that pays in one place alone, learned: real steps of the design, and the policy's return beside that of the
same design and training with the reward declared.

python lab/benchmarks/bench_hidden.py --dimensions 2 4 --seeds 100 101 102 103 104

Each seed hides the bump in a place of its own. ``--criterion latin_hypercube`` asks as many real steps as the adaptive
design took, in one hypercube. Returns are means over 100 real episodes from the declared starts.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import numpy as np
import torch
from common import parser, started, write

import surrogym
from support.hidden_bump import HiddenBump
from surrogym_shared.port import SurrogatePort
from surrogym_shared.spec import Design, EnvironmentSpec
from surrogym_trainer.policies.files import load_policy
from surrogym_trainer.training import TrainSettings, train

BUDGETS = {2: 60, 4: 150}
REACH = {2: None, 4: 0.5}  # where episodes start: with the reward declared, FASTPPO never meets it in four dimensions
EPISODES = 100


def designed(bump: HiddenBump, spec: EnvironmentSpec) -> tuple[surrogym.Design, list[float]]:
    """A design that has ended, and the rewards that it met."""
    design, met = surrogym.Design(spec), []
    while (query := design.ask()) is not None:
        step = bump.step_from(query.coordinates, query.action)
        design.tell(query, step)
        met.append(step.reward)
    return design, met


def real_return(bump: HiddenBump, policy: Path, algorithm: str) -> float:
    """Mean return of a policy in the original environment."""
    spec, act, rng = bump.spec(), load_policy(policy, algorithm), np.random.default_rng(10_000)
    low, high = np.array([(c.low, c.high) for c in spec.start.values()]).T  # type: ignore[union-attr]
    x, total = rng.uniform(low, high, (EPISODES, bump.dimensions)), np.zeros(EPISODES)
    for _ in range(spec.time_limit or 0):
        u = np.asarray(act(x.astype(np.float32)), dtype=float)
        total += [bump.pay(at, by) for at, by in zip(x, u, strict=True)]
        x = np.array([bump.step_from(at, by).next_coordinates for at, by in zip(x, u, strict=True)])
    return float(total.mean())


def largest_error(bump: HiddenBump, design: surrogym.Design) -> float:
    """Of the model's reward, over points around the bump."""
    rng = np.random.default_rng(0)
    x = bump.place + 2 * bump.width * rng.standard_normal((200, bump.dimensions))
    u = rng.uniform(-1, 1, x.shape)
    foretold = design.surrogate().model.transition(torch.from_numpy(x), torch.from_numpy(u)).reward.numpy()
    return float(np.abs(foretold - [bump.pay(*point) for point in zip(x, u, strict=True)]).max())


def trained(bump: HiddenBump, port: SurrogatePort, steps: int | None) -> tuple[float, float]:
    """Real and imagined return of a policy learned in a surrogate."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "policy.zip"
        result = train(port, path, TrainSettings(algorithm="fastppo", seed=bump.seed, total_steps=steps))
        return real_return(bump, path, result.algorithm), float(result.imagined_return or 0.0)


def run(options: argparse.Namespace, dimensions: int, seed: int) -> dict[str, Any]:
    """Design and training, with the reward learned and declared."""
    rows, begun = {}, time.perf_counter()
    for name in ("learned", "declared"):
        bump = HiddenBump(dimensions, seed, declared=name == "declared", reach=REACH[dimensions])
        design, met = designed(bump, asking(bump, budget=BUDGETS[dimensions]))
        if options.criterion and not bump.declared:
            design, met = designed(bump, asking(bump, budget=len(met), acquisition=options.criterion))
        off = largest_error(bump, design)
        rows[name] = {"steps": len(met), "phase": design.phase, "highest": max(met), "off": off}
        if options.train:
            rows[name]["real"], rows[name]["imagined"] = trained(bump, design.surrogate(), options.steps)
    return {"dimensions": dimensions, "seed": seed, **rows, "seconds": time.perf_counter() - begun}


def asking(bump: HiddenBump, **design: Any) -> EnvironmentSpec:
    """The specification with these settings of its design."""
    return bump.spec().model_copy(update={"design": Design(seed=bump.seed, **design)})


def main() -> None:
    made = parser(__doc__)
    made.add_argument("--dimensions", type=int, nargs="+", default=[2, 4], choices=sorted(BUDGETS))
    made.add_argument("--seeds", type=int, nargs="+", default=[100, 101, 102, 103, 104])
    made.add_argument("--criterion", help="acquisition beside which the adaptive one is to be judged")
    made.add_argument("--steps", type=int, help="virtual steps of a training")
    made.add_argument("--no-train", dest="train", action="store_false", help="the design alone")
    options = started(made)
    rows = []
    for dimensions in options.dimensions:
        for seed in options.seeds:
            rows.append(run(options, dimensions, seed))
            print(rows[-1])
    write(options.out, f"hidden-{options.criterion or 'adaptive'}", {"rows": rows})


if __name__ == "__main__":
    main()
