"""A log of 5,000 rows without a machine: seconds until there is a model, and the policy's return in the plant.

Beside it stands the return of a policy that the same training learned in the plant itself.

python lab/benchmarks/bench_logs.py --seeds 0 1 2 3 4

Each seed makes a log of its own (examples/reactor.py). Both policies start where the log's episodes began, and are
evaluated in the plant from 100 of these starts. The surrogate takes no real step.
"""

from __future__ import annotations

import argparse
import sys
import time
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))

import numpy as np
import reactor
from bench_start import serving
from common import parser, started, write

from surrogym_client.surrogates.waiting import wait_for_model
from surrogym_client.transport import Api, HttpSurrogate
from surrogym_lab.original_port import OriginalPort
from surrogym_sampler.logs import import_log
from surrogym_sampler.original import make
from surrogym_sampler.original.episode import Episode
from surrogym_sampler.original.episodes import open_episode
from surrogym_shared.port import SurrogatePort
from surrogym_shared.spec import EnvironmentSpec
from surrogym_trainer.evaluation.evaluator import EvaluationSettings, evaluate
from surrogym_trainer.policies.files import load_policy
from surrogym_trainer.training import TrainSettings, train
from surrogym_trainer.training.settings import chosen_for

PLANT, PATIENCE = "reactor:Reactor", 300.0


def opened(spec: EnvironmentSpec) -> Episode:
    """Episodes of the plant that begin where the log's did. The plant pays its own reward, also outside of the log."""
    return open_episode(PLANT, spec, partial(make, PLANT, spec=spec))


def returns(path: Path, algorithm: str, spec: EnvironmentSpec) -> dict[str, float]:
    """Return of a policy in the plant."""
    result = evaluate(load_policy(path, algorithm), partial(opened, spec), EvaluationSettings(episodes=100))
    return {"mean": float(result.returns.mean()), "worst": float(result.returns.min())}


def trained(port: SurrogatePort, path: Path, settings: TrainSettings, spec: EnvironmentSpec) -> dict[str, Any]:
    begun = time.perf_counter()
    result = train(port, path, settings)
    seconds = time.perf_counter() - begun
    return {**returns(path, result.algorithm, spec), "imagined": result.imagined_return, "seconds": seconds}


def run(seed: int, steps: int | None, rows: int, *, trains: bool) -> dict[str, Any]:
    """One log: the model, and if ``trains`` its policy, and the policy of the plant."""
    with TemporaryDirectory() as place, serving(Path(place)) as url, Api(url) as api:
        folder = Path(place)
        reactor.write(str(folder / "log.csv"), list(reactor.operate(runs=rows // 100, seed=seed)))
        begun = time.perf_counter()
        log = import_log(folder / "log.csv", register="log", url=url).log
        view = wait_for_model(api, "log", PATIENCE)
        known = time.perf_counter() - begun
        if not trains:
            return {"seed": seed, "seconds to a model": known}
        asked = TrainSettings(seed=seed, total_steps=steps)
        plant = log.spec.model_copy(update={"outside_reward": None})
        with HttpSurrogate(url, "log") as port:
            ours = trained(port, folder / "ours.zip", chosen_for(view, asked), plant)
        original = OriginalPort(plant, partial(opened, plant))
        theirs = trained(original, folder / "theirs.zip", asked, plant)
        ledger = api.surrogate("log").ledger
    row = {"seed": seed, "seconds to a model": known, "real steps": ledger.total, "logged": ledger.logged}
    return {**row, "log": ours, "plant": theirs, "plant's steps": original.steps}


def main() -> None:
    made = parser(__doc__)
    made.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    made.add_argument("--steps", type=int, help="virtual steps of each training")
    made.add_argument("--rows", type=int, default=5_000)
    made.add_argument("--only-model", action="store_true", help="stop when there is a model")
    options: argparse.Namespace = started(made)
    rows = []
    for seed in options.seeds:
        rows.append(run(seed, options.steps, options.rows, trains=not options.only_model))
        print(rows[-1])
    if not options.only_model:
        gaps = [row["plant"]["mean"] - row["log"]["mean"] for row in rows]
        print("what the policy of the log earns less, in each log:", np.round(gaps, 2).tolist())
    write(options.out, "logs", {"rows": rows})


if __name__ == "__main__":
    main()
