"""Many sessions step for a long time while queries are claimed and models fitted: no error, and no memory kept."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest

from support.chaos import times
from support.hostile import resident_mib
from support.noting import until
from support.server import running_server
from support.teaching import teach
from surrogym_client.sb3 import SurrogateVecEnv
from surrogym_client.transport import Api
from surrogym_sampler.original.classic import pendulum
from surrogym_sampler.original.gymnasium import GymnasiumEnvironment
from surrogym_sampler.original.protocol import Array, RealStep
from surrogym_sampler.queries import Sampler, SamplerSettings

SESSIONS, LANES, THREADS = times(short=8, full=64), 16, 4
SECONDS, WARM_SECONDS = times(short=4, full=600), times(short=1, full=60)
GROWTH = 1.05
NEVER = 1e-9  # a tolerance that no model reaches
REAL_STEP_SECONDS = 0.2


class Slow(GymnasiumEnvironment):
    def step_from(self, coordinates: Array, action: Array) -> RealStep:
        time.sleep(REAL_STEP_SECONDS)
        return super().step_from(coordinates, action)


@contextmanager
def learning(url: str) -> Iterator[None]:
    """A design that goes on for the time of the context: claims, samples and fits."""
    spec = pendulum()
    design = spec.design.model_copy(update={"initial": 6, "budget": 10_000, "monte_carlo": 64})
    tolerances = dict.fromkeys(("theta", "speed", "reward"), NEVER)
    with Api(url) as api:
        api.create_surrogate("learning", spec.model_copy(update={"design": design, "tolerances": tolerances}))
        sampler = Sampler(api, "learning", Slow(spec), SamplerSettings(name="soak", batch=2, wait_seconds=0.5))
        thread = threading.Thread(target=sampler.run)
        thread.start()
        try:
            yield
        finally:
            sampler.stop()
            thread.join(timeout=120)


def steps(envs: list[SurrogateVecEnv], enough: threading.Event) -> list[float]:
    """Step all of some sessions in turn until it is enough; the seconds that each request took."""
    source, taken = np.random.default_rng(0), []
    for env in envs:
        env.reset()
    while not enough.is_set():
        for env in envs:
            action = source.uniform(-2, 2, (LANES, 1)).astype(np.float32)
            started = time.perf_counter()
            observation, *_ = env.step(action)
            taken.append(time.perf_counter() - started)
            assert np.isfinite(observation).all()
    return taken


@pytest.mark.timeout(1_200)
def test_a_server_under_long_load_has_no_errors_and_no_memory_growth(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    with running_server(tmp_path) as server, ExitStack() as stack:
        api = stack.enter_context(Api(server.url))
        teach(api, "pendulum", pendulum(), queries=12)
        envs = [SurrogateVecEnv(server.url, "pendulum", LANES, seed=seed) for seed in range(SESSIONS)]
        for env in envs:
            stack.callback(env.close)
        stack.enter_context(learning(server.url))
        pool, enough = stack.enter_context(ThreadPoolExecutor(THREADS)), threading.Event()
        stack.callback(enough.set)
        working = [pool.submit(steps, envs[i::THREADS], enough) for i in range(THREADS)]
        assert until(lambda: api.surrogate("learning").model_version), "fits are under way"
        time.sleep(WARM_SECONDS)
        before, fitted = resident_mib(server.process.pid), api.surrogate("learning").model_version
        time.sleep(SECONDS - WARM_SECONDS)
        assert until(lambda: api.surrogate("learning").model_version != fitted), "and go on"
        after, view = resident_mib(server.process.pid), api.surrogate("learning")
        enough.set()
        taken = np.concatenate([work.result() for work in working])
        median, slow = 1e3 * np.quantile(taken, [0.5, 0.99])
        with capsys.disabled():
            print(
                f"\n{SESSIONS} sessions of {LANES} lanes, {SECONDS} s: {len(taken)} steps, median {median:.1f} ms, "
                f"p99 {slow:.1f} ms; {view.ledger.total} samples, model {view.model_version}; "
                f"{before:.0f} MiB, then {after:.0f} MiB"
            )
    assert after < GROWTH * before
    assert "Traceback" not in server.log
