"""A policy that acts on the server, beside one that waits for every step, and both beside the same in this process.

Rollouts of 64 steps, and trainings of FASTPPO; subjects take turns. Run by ``make bench``.
"""

from __future__ import annotations

import statistics
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import numpy as np
from bench_step import in_process, surrogym_server
from common import MICROSECONDS, Call, figures, parser, ratio, started, take_turns, timed, write
from threadpoolctl import threadpool_limits

from support.acting import random_policy, stepped
from surrogym_client.transport import HttpSurrogate
from surrogym_shared.acting import Actor, NoiseKey
from surrogym_shared.port import PolicyPort
from surrogym_shared.wire import OpenSession
from surrogym_trainer.training import TrainSettings, train

LANES, STEPS = (16, 1024), 64
POLICY = random_policy((3, 64, 64, 1))  # of the size that FASTPPO learns
NOISE = NoiseKey(0)
TRAINING_STEPS, PAIRS = 150_000, 6


def rollouts(port: PolicyPort, lanes: int) -> dict[str, Call]:
    """Rollouts of new sessions: of a policy there, of one here that steps, and of given actions."""
    start = {}
    for _ in range(3):
        session = port.open(OpenSession(num_envs=lanes, seed=0, autoreset_mode="same_step")).id
        start[session] = port.reset(session).observation
    by_rollout, by_step, given = start
    actor = Actor(POLICY, 3, np.array([-2.0]), np.array([2.0]), noisy=True)
    actions = np.random.default_rng(0).uniform(-2, 2, (STEPS, lanes, 1))
    return {
        "by rollout": lambda: port.rollout_policy(by_rollout, POLICY, STEPS, noise=NOISE),
        "by step": lambda: stepped(port, by_step, actor, start[by_step], STEPS, NOISE),
        "given actions": lambda: port.rollout(given, actions),
    }


def throughput(ports: dict[str, PolicyPort], lanes: int, quick: bool) -> dict[str, Any]:
    """Microseconds of a rollout, and the shares of in process that the stream reaches."""
    calls = {f"{where}, {how}": call for where, port in ports.items() for how, call in rollouts(port, lanes).items()}
    turns = take_turns({name: timed(call) for name, call in calls.items()}, 3 if quick else 20, calls=4, warm_up=3)
    found: dict[str, Any] = {name: figures(taken) for name, taken in turns.items()}
    for how in ("by rollout", "by step", "given actions"):
        found[f"share, {how}"] = 1 / ratio(turns[f"stream, {how}"], turns[f"in process, {how}"])
    found["stream by rollout / in process by step"] = 1 / ratio(
        turns["stream, by rollout"], turns["in process, by step"]
    )
    return found


def trainings(ports: dict[str, PolicyPort], quick: bool) -> dict[str, Any]:
    """Seconds of whole trainings of FASTPPO, in turns."""
    taken: dict[str, list[float]] = {name: [] for name in ports}
    imagined: dict[str, list[float | None]] = {name: [] for name in ports}
    steps = 24_576 if quick else TRAINING_STEPS
    with TemporaryDirectory() as folder:
        for seed in range(-1, 2 if quick else PAIRS):  # the first warms up
            for name, port in ports.items():
                settings = TrainSettings(algorithm="fastppo", total_steps=steps, seed=max(seed, 0), prolong=False)
                start = time.perf_counter()
                result = train(port, Path(folder) / "policy.zip", settings)
                if seed >= 0:
                    taken[name].append(time.perf_counter() - start)
                    imagined[name].append(result.imagined_return)
    pairs = sorted(r / i for r, i in zip(taken["stream"], taken["in process"], strict=True))
    return {"steps": steps, "seconds": taken, "imagined": imagined, "ratio": statistics.median(pairs), "pairs": pairs}


def shown(lanes: int, found: dict[str, Any]) -> str:
    p50 = {name: value["p50"] for name, value in found.items() if isinstance(value, dict)}
    rates = "; ".join(f"{name} {lanes * STEPS * MICROSECONDS / us:,.0f}/s" for name, us in p50.items())
    shares = "; ".join(f"{name} {value:.1%}" for name, value in found.items() if not isinstance(value, dict))
    return f"N = {lanes}: {rates}\n  {shares}"


def main() -> None:
    options = started(parser(__doc__))
    report: dict[str, Any] = {"lanes": {}}
    with surrogym_server() as url, ExitStack() as stack, threadpool_limits(limits=1):
        remote = stack.enter_context(HttpSurrogate(url, "pendulum", transport="stream"))
        ports: dict[str, PolicyPort] = {"in process": in_process(url), "stream": remote}
        for lanes in LANES:
            report["lanes"][lanes] = throughput(ports, lanes, options.quick)
            print(shown(lanes, report["lanes"][lanes]))
        report["trainings"] = trainings(ports, options.quick)
        whole = report["trainings"]
        print(f"FASTPPO, {whole['steps']:,} steps: remote takes {whole['ratio']:.3f} of in process; {whole['seconds']}")
        print(f"imagined returns {whole['imagined']}")
    write(options.out, "rollout", report)


if __name__ == "__main__":
    main()
