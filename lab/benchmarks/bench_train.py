"""PPO on 16 lanes, remote beside the same model in process; rounds take turns. Run by ``make bench``."""

from __future__ import annotations

import statistics
import sys
import time
from contextlib import ExitStack
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

from bench_step import in_process, surrogym_server
from common import parser, started, write
from stable_baselines3 import PPO

from surrogym_client.sb3 import SurrogateVecEnv
from surrogym_client.transport import HttpSurrogate

LANES, STEPS, PAIRS = 16, 256, 20  # steps of each lane between two updates, and of a turn


def main() -> None:
    options = started(parser(__doc__))
    with surrogym_server() as url, ExitStack() as stack:
        remote = stack.enter_context(HttpSurrogate(url, "pendulum", transport="stream"))
        ports = {"in process": in_process(url), "stream": remote}
        learners = {
            name: PPO("MlpPolicy", SurrogateVecEnv.from_port(port, num_envs=LANES, seed=0), n_steps=STEPS, seed=0)
            for name, port in ports.items()
        }
        for learner in learners.values():
            learner.learn(LANES * STEPS)
        taken: dict[str, list[float]] = {name: [] for name in learners}
        for _ in range(3 if options.quick else PAIRS):
            for name, learner in learners.items():
                start = time.perf_counter()
                learner.learn(LANES * STEPS)
                taken[name].append(time.perf_counter() - start)
        for learner in learners.values():
            learner.get_env().close()
    pairs = sorted(r / i for r, i in zip(taken["stream"], taken["in process"], strict=True))
    seconds = {name: statistics.median(each) for name, each in taken.items()}
    quartiles = pairs[len(pairs) // 4], pairs[-1 - len(pairs) // 4]
    report = {"seconds": seconds, "ratio": statistics.median(pairs), "quartiles": quartiles, "pairs": taken}
    print(f"PPO, {LANES} lanes, {LANES * STEPS:,} steps, seconds: {seconds}")
    print(
        f"remote takes {report['ratio']:.3f} of in process, median of {len(pairs)} pairs, half of them in {quartiles}"
    )
    write(options.out, "train", report)


if __name__ == "__main__":
    main()
