"""What steps of a session take while its own surrogate is given samples and fitted, beside the same in rest.

Run by ``make bench``. Spells with and without take turns. A process of its own answers queries of ``pendulum`` for as
long as a spell lasts and asks for more of them, so that one fit follows another, each with more samples, and every
fit becomes a model that lanes move to at their next reset.

Before that, what one fit takes by the number of samples: cart-pole, whose four coordinates are learned.
"""

from __future__ import annotations

import multiprocessing as mp
import sys
import time
from contextlib import ExitStack
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import numpy as np
from bench_step import surrogym_server
from common import figures, parser, ratio, started, write

from support.models import learn
from support.real_steps import random_steps
from support.teaching import answer
from surrogym_client.transport import Api, HttpSurrogate
from surrogym_sampler.original.classic import cartpole, pendulum
from surrogym_sampler.original.gymnasium import GymnasiumEnvironment
from surrogym_server.convert import definition_from_spec
from surrogym_shared import wire
from surrogym_shared.wire import OpenSession

LANES, TIME_LIMIT, QUERIES = (1, 1_024), 50, 4
SIZES = (500, 1_000, 2_000, 5_000)  # samples
SPELLS, SPELL_SECONDS, SETTLING_SECONDS = 6, 2.0, 1.5


def teach_on(url: str, wanted: Event, ending: Event) -> None:
    """While it is wanted: ask for queries, answer them, wait for the fit."""
    original = GymnasiumEnvironment(pendulum())
    with Api(url) as api:
        while not ending.is_set():
            if not wanted.wait(0.1):
                continue
            claimed = api.claim("pendulum", "teacher", max_queries=QUERIES, wait_seconds=0.2)
            steps = [query for query in claimed.queries if isinstance(query, wire.StepQuery)]
            if steps:
                api.add_samples("pendulum", "teacher", [answer(original, query) for query in steps])
            elif claimed.phase in ("ready", "over_budget"):
                api.improve("pendulum", QUERIES)


def spell(port: HttpSurrogate, session: str, action: np.ndarray, seconds: float) -> list[float]:
    """Seconds of each step."""
    taken, end = [], time.perf_counter() + seconds
    while (start := time.perf_counter()) < end:
        port.step(session, action)
        taken.append(time.perf_counter() - start)
    return taken


def measured(url: str, lanes: int, wanted: Event, spells: int) -> dict[str, Any]:
    rng = np.random.default_rng(0)
    with ExitStack() as stack, Api(url) as api:
        port = stack.enter_context(HttpSurrogate(url, "pendulum", transport="stream"))
        session = port.open(OpenSession(num_envs=lanes, seed=0, time_limit=TIME_LIMIT, autoreset_mode="same_step")).id
        port.reset(session)
        action = rng.uniform(-2, 2, (lanes, 1))
        spell(port, session, action, SETTLING_SECONDS)
        before = len(api.models("pendulum"))
        turns: dict[str, list[list[float]]] = {"rest": [], "samples and fits": []}
        for _ in range(spells):
            turns["rest"].append(spell(port, session, action, SPELL_SECONDS))
            wanted.set()
            turns["samples and fits"].append(spell(port, session, action, SPELL_SECONDS))
            wanted.clear()
            spell(port, session, action, SETTLING_SECONDS)  # the last fit ends
        models = api.models("pendulum")
    found: dict[str, Any] = {name: figures(rounds) for name, rounds in turns.items()}
    for name, rounds in turns.items():
        found[name]["longest"] = 1e6 * max(max(taken) for taken in rounds)
    found["ratio"] = ratio(turns["samples and fits"], turns["rest"])
    found["p99 ratio"] = found["samples and fits"]["p99"] / found["rest"]["p99"]
    return {**found, "fits": len(models) - before, "samples": models[-1].samples}


def fitted(samples: int) -> dict[str, float]:
    """Seconds, and seconds of processor time, of one fit of random samples."""
    definition, steps = definition_from_spec(cartpole()), random_steps(cartpole(), samples, seed=0)
    wall, processor = time.perf_counter(), time.process_time()
    learn(definition, steps)
    return {"seconds": time.perf_counter() - wall, "processor": time.process_time() - processor}


def main() -> None:
    options = started(parser(__doc__))
    context = mp.get_context("spawn")
    wanted, ending = context.Event(), context.Event()
    report: dict[str, Any] = {"lanes": {}, "sizes": {}}
    for samples in SIZES[:1] if options.quick else SIZES:
        report["sizes"][samples] = found = fitted(samples)
        print(f"n = {samples:,}: {found['seconds']:.1f} s, {found['processor']:.1f} s of processor time")
    with surrogym_server() as url:
        teacher = context.Process(target=teach_on, args=(url, wanted, ending))
        teacher.start()
        try:
            for lanes in LANES:
                found = measured(url, lanes, wanted, 2 if options.quick else SPELLS)
                report["lanes"][lanes] = found
                print(f"N = {lanes:,}: {found['fits']} fits, {found['samples']} samples in the end")
                for name in ("rest", "samples and fits"):
                    print(f"  {name:18}" + "".join(f"{k:>9} {v:8,.0f} us" for k, v in found[name].items()))
                print(f"  ratio of medians {found['ratio']:.2f}, of p99 {found['p99 ratio']:.2f}")
        finally:
            ending.set()
            teacher.join(30)
    write(options.out, "fit", report)


if __name__ == "__main__":
    main()
