"""PPO on 16 lanes, remote beside the same model in process; rounds take turns. Run by ``make bench``."""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import torch
from bench_step import in_process, machine, surrogym_server
from stable_baselines3 import PPO

from surrogym_client.sb3 import SurrogateVecEnv
from surrogym_client.transport import HttpSurrogate

LANES, STEPS, ROUNDS = 16, 256, 6  # steps of each lane between two updates, of which a round makes two
UPDATES = 2


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("build/benchmarks"), help="folder of the JSON file")
    options = parser.parse_args()
    torch.set_num_threads(1)
    report: dict[str, Any] = {"machine": machine()}
    with surrogym_server() as url, ExitStack() as stack:
        remote = stack.enter_context(HttpSurrogate(url, "pendulum", transport="stream"))
        ports = {"in process": in_process(url), "stream": remote}
        learners = {
            name: PPO("MlpPolicy", SurrogateVecEnv.from_port(port, num_envs=LANES, seed=0), n_steps=STEPS, seed=0)
            for name, port in ports.items()
        }
        taken: dict[str, list[float]] = {name: [] for name in learners}
        for learner in learners.values():
            learner.learn(LANES * STEPS)
        for _ in range(ROUNDS):
            for name, learner in learners.items():
                start = time.perf_counter()
                learner.learn(UPDATES * LANES * STEPS)
                taken[name].append(time.perf_counter() - start)
        for learner in learners.values():
            learner.get_env().close()
    report["seconds"] = {name: statistics.median(seconds) for name, seconds in taken.items()}
    report["ratio"] = statistics.median(r / i for r, i in zip(taken["stream"], taken["in process"], strict=True))
    print(f"PPO, {LANES} lanes, {UPDATES * LANES * STEPS:,} steps, seconds: {report['seconds']}")
    print(f"remote takes {report['ratio']:.3f} of in process, median of {ROUNDS} pairs")
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "train.json").write_text(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
