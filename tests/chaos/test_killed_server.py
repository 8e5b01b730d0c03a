"""kill -9 of the server at random moments of a design with three samplers: nothing acknowledged is lost, nothing is
there twice, the design completes, and the ledger tells the truth."""

from __future__ import annotations

import random
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from support.chaos import SEED, times
from support.server import RestartingServer
from surrogym_client.api import Api
from surrogym_client.original.classic import pendulum
from surrogym_client.original.gymnasium import GymnasiumEnvironment
from surrogym_client.original.protocol import Array, RealStep
from surrogym_client.sampler import Sampler, SamplerSettings
from surrogym_shared import wire

KILLS = times(short=2, full=100)
SAMPLERS, BUDGET, KILLS_A_RUN = 3, 18, 10
OUTPUTS = ("theta", "speed", "reward")
NEVER = 1e-9  # a tolerance that no model of so few samples reaches
STEP_SECONDS, LONGEST_LIFE = 0.1, 2.0


@dataclass
class Took:
    """What the samplers know: every real step they took, and every sample that the server acknowledged."""

    steps: list[tuple[float, ...]] = field(default_factory=list)
    acknowledged: dict[int, wire.NewSample] = field(default_factory=dict)
    lock: threading.Lock = field(default_factory=threading.Lock)


class Counted(GymnasiumEnvironment):
    """Pendulum, a little slower, counting its steps."""

    def __init__(self, took: Took) -> None:
        super().__init__(pendulum())
        self._took = took

    def step_from(self, coordinates: Array, action: Array) -> RealStep:
        time.sleep(STEP_SECONDS)
        step = super().step_from(coordinates, action)
        with self._took.lock:
            self._took.steps.append((*step.coordinates, *step.action))
        return step


class Acknowledging(Api):
    """Remembers what was acknowledged."""

    def __init__(self, url: str, took: Took) -> None:
        super().__init__(url)
        self._took = took

    def add_samples(
        self, name: str, sampler: str, samples: Sequence[wire.NewSample], *, idempotency_key: str | None = None
    ) -> wire.AddedSamples:
        added = super().add_samples(name, sampler, samples, idempotency_key=idempotency_key)
        with self._took.lock:
            self._took.acknowledged.update(zip(added.sample_ids, samples, strict=True))
        return added


@contextmanager
def samplers(url: str, name: str, took: Took) -> Iterator[None]:
    """Three workers until the end of the context, in threads: they outlive the server."""

    def work(number: int) -> None:
        with Acknowledging(url, took) as api:
            settings = SamplerSettings(name=f"worker {number}", batch=2, wait_seconds=0.5)
            worker = Sampler(api, name, Counted(took), settings)
            workers.append(worker)
            worker.run()

    workers: list[Sampler] = []
    threads = [threading.Thread(target=work, args=(number,)) for number in range(SAMPLERS)]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        for worker in workers:
            worker.stop()
        for thread in threads:
            thread.join(timeout=120)


def until(api: Api, name: str, holds: Callable[[wire.SurrogateView], bool], seconds: float = 180.0) -> bool:
    """Whether it holds before the time is over."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if holds(api.surrogate(name)):
            return True
        time.sleep(0.05)
    return False


def done(view: wire.SurrogateView) -> bool:
    return view.phase in ("ready", "over_budget")


@pytest.mark.timeout(3_600)
def test_nothing_acknowledged_is_lost_and_the_ledger_is_true(tmp_path: Path):
    source, killed = random.Random(SEED), 0
    server = RestartingServer(tmp_path)
    try:
        while killed < KILLS:
            name, took = f"run-{killed}", Took()
            spec = pendulum()
            design = spec.design.model_copy(update={"initial": 6, "budget": BUDGET, "monte_carlo": 64})
            with Api(server.url) as api:
                api.create_surrogate(
                    name, spec.model_copy(update={"design": design, "tolerances": dict.fromkeys(OUTPUTS, NEVER)})
                )
                with samplers(server.url, name, took):
                    for _ in range(min(KILLS_A_RUN, KILLS - killed)):
                        done_early = until(api, name, done, seconds=source.uniform(0.0, LONGEST_LIFE))
                        server.stop(signal.SIGKILL)
                        killed += 1
                        server.start()
                        if done_early:
                            break
                    assert until(api, name, done), f"the design completes, but is {api.surrogate(name)}"
                judge(api, name, took)
    finally:
        server.stop()


def judge(api: Api, name: str, took: Took) -> None:
    stored = {sample.id: sample for sample in api.samples(name)}
    for id, sample in took.acknowledged.items():
        assert (stored[id].coordinates, stored[id].reward) == (sample.coordinates, sample.reward), "as acknowledged"
    assert len({(sample.query_id, sample.attempt) for sample in stored.values()}) == len(stored), "none is there twice"
    ledger = api.surrogate(name).ledger
    assert ledger.total == len(stored)
    assert ledger.total == len(took.acknowledged) == len(took.steps), "the samplers were patient"
    identities = np.array(sorted((*s.coordinates, *s.action) for s in stored.values()))
    np.testing.assert_array_equal(identities, np.array(sorted(took.steps)))
    assert len(stored) >= BUDGET
