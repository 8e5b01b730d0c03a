"""Throughput of 1 to 32 samplers of one surrogate, beside linear, and what takes the processor time.

Each sampler is a process with an environment that sleeps 50 ms in each step. Queries made by hand keep the queue full,
so that no fit is due. The rate is counted in the ledger, over a window that begins after each sampler has answered.
The processor time of server and samplers in this window is divided by the samples, and shows the first bottleneck.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import numpy as np
from common import parser, started, write

from support.postgresql import running_postgresql
from support.server import ServerProcess, running_server
from surrogym_client.transport import Api
from surrogym_sampler.original.classic import pendulum
from surrogym_sampler.original.gymnasium import GymnasiumEnvironment
from surrogym_sampler.original.protocol import Array, RealStep
from surrogym_sampler.queries import Sampler, SamplerSettings

STEP_SECONDS = 0.05
COUNTS, QUICK_COUNTS = (1, 2, 4, 8, 16, 32), (1, 4)
WINDOW, QUICK_WINDOW = 15.0, 4.0  # seconds
BATCHES = (1, 4)  # queries of one claim; 4 is the default
CHUNK, BUDGET = 1_000, 100_000
FORK = multiprocessing.get_context("fork")  # the samplers need not import everything again
TICKS = os.sysconf("SC_CLK_TCK")


class Sleeping(GymnasiumEnvironment):
    """Pendulum, each step of which takes 50 ms more."""

    def step_from(self, coordinates: Array, action: Array) -> RealStep:
        time.sleep(STEP_SECONDS)
        return super().step_from(coordinates, action)


@dataclass(frozen=True)
class Rate:
    """What a number of samplers reached."""

    samples_per_second: float
    server_ms: float  # of processor time, for each sample; with those of PostgreSQL
    sampler_ms: float
    server_cores: float


def work(url: str, name: str, batch: int) -> None:
    with Api(url) as api:
        Sampler(api, name, Sleeping(pendulum()), SamplerSettings(batch=batch, wait_seconds=1.0)).run()


def cpu_seconds(pids: Sequence[int]) -> float:
    """Processor time of processes, and of their children that have ended. A process that has ended is one of these."""
    ticks = 0
    for pid in pids:
        try:
            fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        except FileNotFoundError:
            continue
        ticks += sum(int(field) for field in fields[11:15])
    return ticks / TICKS


def fill(api: Api, name: str, queries: int) -> None:
    """Register a surrogate with that many queries."""
    spec = pendulum()
    design = spec.design.model_copy(update={"initial": 2, "budget": BUDGET})
    api.create_surrogate(name, spec.model_copy(update={"design": design}))
    random = np.random.default_rng(0)
    for first in range(0, queries, CHUNK):
        count = min(CHUNK, queries - first)
        coordinates = random.uniform(-1, 1, (count, 2))
        api.add_queries(name, coordinates.tolist(), random.uniform(-1, 1, (count, 1)).tolist())


def rate(url: str, servers: Callable[[], Sequence[int]], name: str, count: int, batch: int, window: float) -> Rate:
    """Let ``count`` samplers work for ``window`` seconds, after all of them have begun."""
    with Api(url) as api:
        fill(api, name, int(count / STEP_SECONDS * (window + 30)))
        samplers = [FORK.Process(target=work, args=(url, name, batch), daemon=True) for _ in range(count)]
        for sampler in samplers:
            sampler.start()
        pids = [sampler.pid or 0 for sampler in samplers]
        while api.surrogate(name).ledger.total < 4 * count:
            time.sleep(0.1)
        watched = (servers(), pids)
        before, begun = [cpu_seconds(some) for some in watched], time.perf_counter()
        first = api.surrogate(name).ledger.total
        time.sleep(window)
        taken, seconds = api.surrogate(name).ledger.total - first, time.perf_counter() - begun
        server, sampler_ = (cpu_seconds(some) - old for some, old in zip(watched, before, strict=True))
        for sampler in samplers:
            sampler.kill()
            sampler.join()
        api.delete_surrogate(name)
    return Rate(taken / seconds, 1e3 * server / taken, 1e3 * sampler_ / taken, server / seconds)


def pids_of(server: ServerProcess, postmaster: int | None) -> list[int]:
    """The server's process, and those of PostgreSQL."""
    found = [server.process.pid]
    if postmaster is not None:
        children = Path(f"/proc/{postmaster}/task/{postmaster}/children").read_text().split()
        found += [postmaster, *map(int, children)]
    return found


def measured(
    storage: tuple[str, str], postmaster: int | None, counts: Sequence[int], batches: Sequence[int], window: float
) -> dict[str, Any]:
    """The rates of a server with that option of its storage."""
    report: dict[str, Any] = {}
    options = ("--log-level", "warning", *storage)
    with TemporaryDirectory() as folder, running_server(Path(folder), *options) as server:
        for batch in batches:
            alone = None  # rate for each sampler of the first number
            for count in counts:
                name = f"samplers-{batch}-{count}"
                found = rate(server.url, lambda: pids_of(server, postmaster), name, count, batch, window)
                alone = alone or found.samples_per_second / count
                linear = found.samples_per_second / (count * alone)
                report[f"{count} samplers, batch {batch}"] = vars(found) | {"of linear": linear}
                print(
                    f"{'PostgreSQL' if postmaster else 'SQLite':10}  batch {batch}  {count:2} samplers  "
                    f"{found.samples_per_second:6.1f} samples/s  {100 * linear:4.0f} % of linear  processor time for "
                    f"each: server {found.server_ms:5.1f} ms, sampler {found.sampler_ms:5.1f} ms; "
                    f"server {found.server_cores:.2f} cores; load {os.getloadavg()[0]:.1f}"
                )
    return report


def main() -> None:
    made = parser(__doc__)
    made.add_argument("--database", choices=("SQLite", "PostgreSQL"), help="only this one")
    made.add_argument("--samplers", type=int, nargs="+", help="numbers of them; shares are of the first one's rate")
    made.add_argument("--claims", type=int, nargs="+", default=BATCHES, help="queries of one claim")
    options = started(made)
    counts, window = (QUICK_COUNTS, QUICK_WINDOW) if options.quick else (COUNTS, WINDOW)
    counts = options.samplers or counts
    report = {}
    if options.database != "PostgreSQL":
        report["SQLite"] = measured((), None, counts, options.claims, window)
    if options.database != "SQLite":
        with running_postgresql() as postgresql:
            storage = ("--database", postgresql.new_database())
            report["PostgreSQL"] = measured(storage, postgresql.pid, counts, options.claims, window)
    write(options.out, "samplers", report)


if __name__ == "__main__":
    main()
