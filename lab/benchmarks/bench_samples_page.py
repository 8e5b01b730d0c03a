"""Where the time of a page of 1,000 samples goes, and its 99th percentile: with searches for garbage after 700 objects
(Python's default), after 20,000, and none, in turns on one PostgreSQL database.

First the processor time of reading, conversion and JSON in this process. ``--in-process`` ends after this. Then pages
over HTTP. The kernel counts the seconds for which each thread ran, and those for which it waited for a core. The time
of a request is divided by these counts of the server, of PostgreSQL and of the client. So the times without waits are
about those of a machine that runs nothing else.
"""

from __future__ import annotations

import gc
import os
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import httpx
import numpy as np
from common import parser, started, write

from support.million import FIRST, fill
from support.postgresql import running_postgresql
from support.server import start_server
from surrogym_server.convert.resources import sample_page
from surrogym_server.storage.sql import open_storage

SAMPLES, PAGE, ROUNDS, CALLS = 20_000, 1_000, 10, 40
THRESHOLDS = {"after 700 objects": 700, "after 20,000 objects": 20_000, "never": 0}
SERVERS = str(Path(__file__).with_name("servers.py"))
WHO = ("server", "PostgreSQL", "client")


def ran_and_waited(pid: int) -> np.ndarray:
    """Milliseconds for which the threads of a process ran, and for which they waited for a core; 0 if it has ended."""
    found = np.zeros(2)
    with suppress(FileNotFoundError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            found += np.array((task / "schedstat").read_text().split()[:2], dtype=float) / 1e6
    return found


def children(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def request(client: httpx.Client, server: int, postmaster: int, path: Callable[[], str]) -> list[float]:
    """Milliseconds of one page, and for which each of ``WHO`` ran and waited."""
    backends = children(postmaster)
    before = {pid: ran_and_waited(pid) for pid in (server, *backends, os.getpid())}
    begun = time.perf_counter()
    client.get(path()).raise_for_status()
    seconds = time.perf_counter() - begun
    since = {pid: np.maximum(ran_and_waited(pid) - counts, 0.0) for pid, counts in before.items()}
    database = sum((since[pid] for pid in backends), np.zeros(2))
    return [1e3 * seconds, *since[server], *database, *since[os.getpid()]]


def summary(rows: Sequence[Sequence[float]]) -> dict[str, float]:
    """Quantiles of a page, and the parts of the slowest hundredth."""
    table = np.array(rows)
    wall, ran, waited = table[:, 0], table[:, 1::2], table[:, 2::2]
    quiet = np.maximum(wall - waited.sum(axis=1), ran.sum(axis=1))
    slowest = wall >= np.quantile(wall, 0.99)
    parts = {f"{who} ran": float(np.median(ran[:, n])) for n, who in enumerate(WHO)}
    parts |= {f"{who} waited, slowest": float(waited[slowest, n].mean()) for n, who in enumerate(WHO)}
    quantiles = {"median": np.median(wall), "99th": np.quantile(wall, 0.99)}
    quantiles |= {"median without waits": np.median(quiet), "99th without waits": np.quantile(quiet, 0.99)}
    return {**{name: float(value) for name, value in quantiles.items()}, **parts}


def in_process(url: str, after: Callable[[], int], rounds: int) -> dict[str, dict[str, float]]:
    """Milliseconds of processor time of a page, and of the searches for garbage during one, for each threshold."""
    storage, rows = open_storage(url), {name: list[float]() for name in THRESHOLDS}
    searches, begun, thresholds = {name: list[float]() for name in THRESHOLDS}, [0.0], gc.get_threshold()
    now = ""

    def search(phase: str, _: dict[str, int]) -> None:
        if phase == "start":
            begun[0] = time.thread_time()
        else:
            searches[now].append(time.thread_time() - begun[0])

    def page() -> float:
        start = time.thread_time()
        sample_page(storage.samples.page(FIRST, after(), PAGE), PAGE).model_dump_json()
        return 1e3 * (time.thread_time() - start)

    page()
    gc.collect()
    gc.freeze()
    try:
        for _ in range(rounds):
            for now, threshold in THRESHOLDS.items():
                gc.set_threshold(threshold, *thresholds[1:])
                gc.callbacks.append(search)
                rows[now] += [page() for _ in range(CALLS)]
                gc.callbacks.remove(search)
    finally:
        gc.set_threshold(*thresholds)
        gc.unfreeze()
        storage.close()
    return {
        name: {
            "pages": len(ms),
            "median": float(np.median(ms)),
            "99th": float(np.quantile(ms, 0.99)),
            "searches a page": len(searches[name]) / len(ms),
            "ms of searches a page": 1e3 * sum(searches[name]) / len(ms),
        }
        for name, ms in rows.items()
    }


def over_http(url: str, postmaster: int, after: Callable[[], int], rounds: int) -> dict[str, dict[str, float]]:
    """Milliseconds of a page from a server with each threshold."""

    def path() -> str:
        return f"/v1/surrogates/{FIRST}/samples?limit={PAGE}&after={after()}"

    with ExitStack() as stack:
        ways = {}
        for name, threshold in THRESHOLDS.items():
            folder = Path(stack.enter_context(TemporaryDirectory()))
            program = (SERVERS, "collecting", str(threshold))
            server = start_server(folder, "--log-level", "warning", "--database", url, program=program)
            stack.callback(server.stop)
            client = stack.enter_context(httpx.Client(base_url=server.url, timeout=120))
            ways[name] = partial(request, client, server.process.pid, postmaster, path)
        for way in ways.values():
            way()
        rows: dict[str, list[list[float]]] = {name: [] for name in ways}
        for _ in range(rounds):
            for name, way in ways.items():
                rows[name] += [way() for _ in range(CALLS)]
    return {name: summary(found) for name, found in rows.items()}


def show(what: str, report: dict[str, dict[str, float]]) -> None:
    print(f"{what}; load {os.getloadavg()[0]:.1f}")
    for name, figures in report.items():
        print(f"  {name}: " + "  ".join(f"{key} {value:.1f}" for key, value in figures.items()))


def main() -> None:
    made = parser(__doc__)
    made.add_argument("--in-process", action="store_true", help="measure no pages over HTTP")
    options = started(made)
    rounds = 2 if options.quick else ROUNDS
    source = np.random.default_rng(0)

    def after() -> int:
        return 1_000 + int(source.integers(SAMPLES // 2 - PAGE))

    with running_postgresql() as postgresql:
        url = postgresql.new_database()
        fill(url, 2, SAMPLES, 0, 16)
        report = {"processor time": in_process(url, after, rounds)}
        show("ms of processor time", report["processor time"])
        if not options.in_process:
            report["over HTTP"] = over_http(url, postgresql.pid, after, rounds)
            show("ms of a page over HTTP", report["over HTTP"])
    write(options.out, "samples_page", report)


if __name__ == "__main__":
    main()
