"""Policy searches side by side on Pendulum's surrogate in this process: PPO of Stable-Baselines3 and FASTPPO.

One batch of an update each, in turns; then whole trainings, in turns, with the imagined return that they came to. Run
by ``make bench``.
"""

from __future__ import annotations

import statistics
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import numpy as np
import torch
from common import figures, parser, ratio, started, take_turns, timed, write
from threadpoolctl import threadpool_limits

from support.models import learn
from support.ppo import OBJECTIVE, ROWS, batch_of, reference
from support.real_steps import random_steps
from surrogym_sampler.original.classic import pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.local import LocalSurrogate
from surrogym_trainer.training import TrainSettings, train
from surrogym_trainer.training.fast_ppo.learner import Learner

SEARCHES = ("ppo", "fastppo")
STEPS, SEEDS, SAMPLES = 600_000, 3, 24


def updates(rounds: int) -> dict[str, Any]:
    """Microseconds of an update with one batch: of both searches, and of six of the products in it."""
    spec, rng = pendulum(), np.random.default_rng(0)
    learner = Learner(spec, np.zeros(3), np.ones(3), (64, 64), rng)
    given, batch = batch_of(learner, rng)
    theirs = reference(learner, spec, given)
    rows, weights = torch.randn(ROWS, 64), torch.randn(64, 64)
    subjects = {
        "ppo": timed(theirs.train),
        "fastppo": timed(lambda: learner.update(batch, OBJECTIVE, 1e-6)),
        "six products": timed(lambda: [rows @ weights for _ in range(6)]),
    }
    turns = take_turns(subjects, rounds, calls=20, warm_up=5)
    found = {name: figures(taken) for name, taken in turns.items()}
    return {"batch": ROWS, "us": found, "ppo / fastppo": ratio(turns["ppo"], turns["fastppo"])}


def trainings(steps: int, seeds: int) -> dict[str, Any]:
    """Seconds and imagined return of whole trainings."""
    spec = pendulum()
    port = LocalSurrogate(spec, learn(definition_from_spec(spec), random_steps(spec, SAMPLES, seed=0)).model)
    found: dict[str, list[dict[str, float]]] = {name: [] for name in SEARCHES}
    with TemporaryDirectory() as folder:
        for seed in range(seeds):
            for name in SEARCHES:
                settings = TrainSettings(algorithm=name, total_steps=steps, seed=seed, prolong=False)
                start = time.perf_counter()
                result = train(port, Path(folder) / "policy.zip", settings)
                assert result.imagined_return is not None
                found[name].append({"seconds": time.perf_counter() - start, "imagined": result.imagined_return})
                print(f"{name}, seed {seed}: {found[name][-1]}")
    pairs = [a["seconds"] / b["seconds"] for a, b in zip(found["ppo"], found["fastppo"], strict=True)]
    return {"steps": steps, "runs": found, "ppo / fastppo": statistics.median(pairs)}


def main() -> None:
    options = started(parser(__doc__))
    with threadpool_limits(limits=1):
        one = updates(3 if options.quick else 20)
    print(f"an update with {ROWS} rows, us: {one['us']}; ratio {one['ppo / fastppo']:.2f}")
    whole = trainings(49_152 if options.quick else STEPS, 1 if options.quick else SEEDS)
    print(f"{whole['steps']:,} virtual steps of Pendulum: ratio of seconds {whole['ppo / fastppo']:.2f}")
    write(options.out, "search", {"updates": one, "trainings": whole})


if __name__ == "__main__":
    main()
