"""Three chemical processes from cold: real steps, and the policy's return beside PPO trained in the original.

python lab/benchmarks/bench_processes.py --seeds 200 201 202 203 204 --oracles 3

``reactor`` has Arrhenius kinetics (examples/reactor.py), ``fermenter`` Haldane kinetics (tests/support/fermenter.py),
and ``van_de_vusse`` a series and a parallel reaction (tests/support/van_de_vusse.py).
Each run is a demo: a server, a sampler and a trainer, and 100 real episodes. The arm ``latin_hypercube`` takes as large
a budget in one hypercube.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))

import numpy as np
from common import parser, started, write

from surrogym.demo.run import run_demo
from surrogym.demo.tasks import DemoTask, Target
from surrogym_lab.runs import begin
from surrogym_lab.settings import StudySettings
from surrogym_lab.tasks import EVERY_TASK

PLANTS = {
    "reactor": "reactor:Reactor",
    "fermenter": "support.fermenter:Fermenter",
    "van_de_vusse": "support.van_de_vusse:VanDeVusse",
}
BUDGET = 100


def run(task: str, seed: int, arm: str) -> dict[str, Any]:
    """Real steps, mean and lowest real return, and the promise of one run."""
    kept: list[dict[str, Any]] = []
    with TemporaryDirectory() as place:
        settings = StudySettings(task, seed, pictures=False, arm=arm)
        run_demo(settings, begin, Path(place) / "run", lambda metrics, _: kept.append(metrics), quiet=True)
    found = kept[0]
    fields = ("real_queries", "phase", "confidence_index", "imagined_return", "promise", "trusted", "virtual_steps")
    real = {name: found["real_return"][name] for name in ("mean", "min")}
    return {"task": task, "seed": seed, "arm": arm, **real, **{name: found.get(name) for name in fields}}


def main() -> None:
    made = parser(__doc__)
    made.add_argument("--tasks", nargs="+", choices=PLANTS, default=list(PLANTS))
    made.add_argument("--seeds", type=int, nargs="+", default=[200, 201, 202, 203, 204])
    made.add_argument("--arms", nargs="+", default=["default"], help="default, latin_hypercube")
    made.add_argument("--oracles", type=int, default=0, help="number of trainings by PPO in the original")
    options: argparse.Namespace = started(made)
    os.environ["PYTHONPATH"] = os.pathsep.join(
        [*sys.path[:2], *filter(None, [os.environ.get("PYTHONPATH")])]
    )  # sampler
    EVERY_TASK.update({task: DemoTask(PLANTS[task], BUDGET, Target("none")) for task in options.tasks})
    rows = []
    for task in options.tasks:
        cases = [("oracle", seed) for seed in options.seeds[: options.oracles]]
        cases += [(arm, seed) for seed in options.seeds for arm in options.arms]
        for arm, seed in cases:
            rows.append(run(task, seed, arm))
            print(rows[-1], flush=True)
        for arm in dict.fromkeys(arm for arm, _ in cases):
            means = [row["mean"] for row in rows if (row["task"], row["arm"]) == (task, arm)]
            print(f"{task}, {arm}: real returns {np.round(means, 3).tolist()}, mean {np.mean(means):.4g}", flush=True)
    write(options.out, "processes", {"rows": rows})


if __name__ == "__main__":
    main()
