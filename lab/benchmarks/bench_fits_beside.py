"""Fits of 16 surrogates with 500 samples each, by one and by two workers: seconds, and how much slower the steps of an
open session are meanwhile.

Each surrogate gets a log of real steps of Pendulum while it is paused. All are released at once. A session of another
surrogate is stepped over the stream before and during the fits.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import numpy as np
from common import parser, started, timed, write

from support.real_steps import random_steps
from support.server import running_server
from support.teaching import teach
from surrogym_client.transport import Api, HttpSurrogate
from surrogym_sampler.original.classic import pendulum
from surrogym_server.environment.samples import Samples
from surrogym_shared import wire
from surrogym_shared.wire import OpenSession

SURROGATES, SAMPLES, QUICK = 16, 500, (4, 100)
WORKERS, LANES = (1, 2), (1, 1_024)
CALLS, PAUSE = 20, 0.2  # steps in a row, and seconds between two rows: a trainer that also computes
SECONDS = 3_000.0


def logged(samples: Samples) -> list[wire.NewSample]:
    rows = zip(samples.q, samples.u, samples.q_next, samples.reward, samples.terminated, strict=True)
    return [
        wire.NewSample(
            coordinates=q.tolist(),
            action=u.tolist(),
            next_coordinates=after.tolist(),
            reward=float(r),
            terminated=bool(t),
        )
        for q, u, after, r, t in rows
    ]


class Stepping(threading.Thread):
    """Steps an open session again and again, and keeps the seconds of each step."""

    def __init__(self, url: str, lanes: int) -> None:
        super().__init__(daemon=True)
        self.seconds: list[float] = []
        self._ending = threading.Event()
        self._port = HttpSurrogate(url, "stepped", transport="stream")
        session = self._port.open(OpenSession(num_envs=lanes, seed=0)).id
        self._port.reset(session)
        self._step = timed(partial(self._port.step, session, np.zeros((lanes, 1))))
        self._step(CALLS)

    def run(self) -> None:
        while not self._ending.wait(PAUSE):
            self.seconds += self._step(CALLS)

    def stop(self) -> list[float]:
        self._ending.set()
        self.join()
        self._port.disconnect()
        return self.seconds


def stepped(url: str, during: Any) -> dict[int, np.ndarray]:
    """Milliseconds of the steps for each number of lanes, while ``during`` runs."""
    threads = {lanes: Stepping(url, lanes) for lanes in LANES}
    for thread in threads.values():
        thread.start()
    during()
    return {lanes: 1e3 * np.array(thread.stop()) for lanes, thread in threads.items()}


def release(api: Api, names: list[str]) -> None:
    """Let the designs begin, and wait until each has a model."""
    for name in names:
        api.patch_surrogate(name, paused=False)
    deadline = time.monotonic() + SECONDS
    while any(api.surrogate(name).model_version is None for name in names):
        failed = [name for name in names if api.surrogate(name).phase == "failed"]
        assert not failed, failed
        assert time.monotonic() < deadline
        time.sleep(0.2)


def measured(workers: int, surrogates: int, samples: list[wire.NewSample]) -> dict[str, Any]:
    with (
        TemporaryDirectory() as folder,
        running_server(Path(folder), "--log-level", "warning", "--fit-workers", str(workers)) as server,
        Api(server.url) as api,
    ):
        teach(api, "stepped", pendulum(), queries=20)
        spec = pendulum()
        design = spec.design.model_copy(update={"initial": 2, "budget": 2})
        names = [f"fitted-{number}" for number in range(surrogates)]
        for name in names:
            api.create_surrogate(name, spec.model_copy(update={"design": design}))
            api.patch_surrogate(name, paused=True)
            api.add_samples(name, "log", samples, purpose="logged")
        before = stepped(server.url, lambda: time.sleep(15.0))
        begun = time.perf_counter()
        meanwhile = stepped(server.url, lambda: release(api, names))
        seconds = time.perf_counter() - begun
    found: dict[str, Any] = {"seconds": seconds, "load": os.getloadavg()[0]}
    print(f"{workers} workers: {surrogates} fits in {seconds:.0f} s; load {found['load']:.1f}")
    for lanes in LANES:
        medians, tails = ([float(np.quantile(ms[lanes], q)) for ms in (before, meanwhile)] for q in (0.5, 0.99))
        found[f"{lanes} lanes"] = {"ms before": medians[0], "ms meanwhile": medians[1], "99th": tails}
        print(
            f"  step of {lanes:5} lanes: median {medians[0]:.2f} ms before, {medians[1]:.2f} ms meanwhile, ratio "
            f"{medians[1] / medians[0]:.2f}; 99th percentile {tails[0]:.1f} and {tails[1]:.1f} ms"
        )
    return found


def main() -> None:
    options = started(parser(__doc__))
    surrogates, count = QUICK if options.quick else (SURROGATES, SAMPLES)
    samples = logged(random_steps(pendulum(), count, seed=0))
    write(
        options.out,
        "fits_beside",
        {f"{workers} workers": measured(workers, surrogates, samples) for workers in WORKERS},
    )


if __name__ == "__main__":
    main()
