"""How long /healthz takes beside clients that wait: streams of events, claims of jobs, claims of queries.

python lab/benchmarks/bench_waiters.py
python lab/benchmarks/bench_waiters.py --postgresql --each 500
python lab/benchmarks/bench_waiters.py --writers

Another process holds ``--each`` connections of each kind open and claims again after each reply. /healthz is measured
without them, beside them, and beside them while one event a second wakes all of them. The waiting process shares the
machine with the server, so measure on two free cores at least.

``--writers`` measures a client instead that enters one step after the other into a ledger: alone, and while a surrogate
of 100,000 initial queries is registered and deleted.
"""

from __future__ import annotations

import asyncio
import json
import multiprocessing
import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from multiprocessing.sharedctypes import Synchronized
from multiprocessing.synchronize import Event
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic, sleep
from typing import Any
from urllib.parse import urlsplit

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import httpx
import numpy as np
from bench_attacks import latencies
from common import machine, parser, started, write

from support.hostile import head, resident_mib
from support.pendulum import spec
from support.postgresql import running_postgresql
from support.server import running_server

NAME = "waited-for"
TOKENS = {"admin": "admin-of-this-benchmark", "read": "reads-only", "train": "trains-only", "sample": "samples-only"}
ADMIN = {"authorization": f"Bearer {TOKENS['admin']}"}
EACH, SECONDS = 2_000, 65.0
MANY = 100_000  # queries of the surrogate that is registered beside a writer
WAIT_SECONDS = 60  # of a claim; so each is renewed once within a measurement
OPEN_AT_ONCE, PAUSE = 10, 0.08  # spread as the clients of many machines are, so that their claims end one by one


def requests() -> dict[str, bytes]:
    """The request of each kind of waiting client."""
    stream = f"GET /v1/surrogates/{NAME}/events HTTP/1.1\r\nhost: 127.0.0.1\r\nauthorization: Bearer {TOKENS['read']}"
    return {
        "streams": f"{stream}\r\n\r\n".encode(),
        "claims of jobs": claim("jobs:claim", "train", {"worker": "waiting", "wait_seconds": WAIT_SECONDS}),
        "claims of queries": claim("queries:claim", "sample", {"sampler": "waiting", "wait_seconds": WAIT_SECONDS}),
    }


def claim(operation: str, role: str, body: dict[str, Any]) -> bytes:
    content = json.dumps(body).encode()
    lines = (f"authorization: Bearer {TOKENS[role]}", f"content-length: {len(content)}", "", "")
    request: bytes = head(f"/v1/surrogates/{NAME}/{operation}", *lines) + content
    return request


class Waiter(asyncio.Protocol):
    """A connection that waits. It sends a claim again when the reply has come."""

    def __init__(self, request: bytes, faults: list[bytes], again: bool) -> None:
        self._request, self._faults, self._again = request, faults, again

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        transport.write(self._request)

    def data_received(self, data: bytes) -> None:
        if data.startswith(b"HTTP/1.1 ") and not data.startswith(b"HTTP/1.1 200"):
            self._faults.append(data)
        elif self._again and b"\r\n\r\n" in data:
            self._transport.write(self._request)

    def connection_lost(self, error: Exception | None) -> None:
        self._faults.append(b"lost")


def wait(url: str, each: int, opened: Synchronized[int], refused: Synchronized[int], stop: Event) -> None:
    """Hold the connections until told to stop."""

    async def hold() -> None:
        faults: list[bytes] = []
        loop, parts = asyncio.get_running_loop(), urlsplit(url)
        host, port = str(parts.hostname), int(parts.port or 80)
        for kind, request in requests().items():
            client = partial(Waiter, request, faults, kind != "streams")
            for start in range(0, each, OPEN_AT_ONCE):
                made = (loop.create_connection(client, host, port) for _ in range(min(OPEN_AT_ONCE, each - start)))
                opened.value += len(await asyncio.gather(*made))
                await asyncio.sleep(PAUSE)
        while not stop.is_set():
            refused.value = len(faults)
            await asyncio.sleep(0.2)

    asyncio.run(hold())


@contextmanager
def waiting(url: str, each: int) -> Iterator[Synchronized[int]]:
    """All clients wait within the context, which gives the number of those that were refused or lost."""
    spawning = multiprocessing.get_context("spawn")
    opened, refused, stop = spawning.Value("i", 0), spawning.Value("i", 0), spawning.Event()
    child = spawning.Process(target=wait, args=(url, each, opened, refused, stop), daemon=True)
    child.start()
    while opened.value < len(requests()) * each:
        if not child.is_alive():
            raise RuntimeError("the waiting process ended")
        sleep(0.1)
    sleep(2.0)  # until all requests have been read
    try:
        yield refused
    finally:
        stop.set()
        child.join(10.0)
        child.kill()


@contextmanager
def events(url: str) -> Iterator[None]:
    """One event a second within the context: the budget changes between 2 and 3."""
    stop = threading.Event()

    def change() -> None:
        with httpx.Client(base_url=url, headers=ADMIN, timeout=60) as client:
            budget = 2
            while not stop.wait(1.0):
                budget = 5 - budget
                client.patch(f"/v1/surrogates/{NAME}", json={"budget": budget}).raise_for_status()

    thread = threading.Thread(target=change)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def figures(taken: list[float]) -> dict[str, float]:
    found = {"p50 ms": float(np.quantile(taken, 0.5)), "p99 ms": float(np.quantile(taken, 0.99))}
    return {**found, "worst ms": max(taken), "requests": len(taken)}


def cpu_seconds(pid: int) -> float:
    """Seconds of a processor that a process has used."""
    user, system = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


def measured(url: str, pid: int, each: int, seconds: float) -> dict[str, Any]:
    """Latencies of /healthz in ms and the server's memory in MiB, alone and beside those who wait."""
    found: dict[str, Any] = {}

    def look(what: str, client: httpx.Client) -> None:
        cpu, begun = cpu_seconds(pid), monotonic()
        taken = figures(latencies(client, seconds))
        share = 100 * (cpu_seconds(pid) - cpu) / (monotonic() - begun)
        found[what] = {**taken, "% of a core": share, "MiB": resident_mib(pid), "load": machine()["load"][0]}
        print(f"{what:32}" + ", ".join(f"{name} {figure:.1f}" for name, figure in found[what].items()))

    with httpx.Client(base_url=url, timeout=60) as client:
        latencies(client, 0.5)
        look("nobody waits", client)
        begun = monotonic()
        with waiting(url, each) as refused:
            print(f"{3 * each} opened in {monotonic() - begun:.0f} s")
            look(f"{each} of each kind wait", client)
            with events(url):
                look("... and one event a second", client)
            found["refused or lost"] = refused.value
        sleep(2.0)
        look("after they have left", client)
    print(f"refused or lost: {found['refused or lost']}")
    return found


def beside(url: str, what: str, work: Callable[[], object]) -> dict[str, Any]:
    """Latencies in ms of a client that writes while ``work`` is done."""
    stop, taken = threading.Event(), list[float]()

    def enter() -> None:
        with httpx.Client(base_url=url, headers=ADMIN, timeout=60) as client:
            while not stop.is_set():
                body = {"steps": 1, "idempotency_key": f"{what} {len(taken)}"}
                begun = monotonic()
                client.post(f"/v1/surrogates/{NAME}/ledger", json=body).raise_for_status()
                taken.append(1e3 * (monotonic() - begun))
                stop.wait(0.01)

    thread, begun = threading.Thread(target=enter), monotonic()
    thread.start()
    try:
        work()
    finally:
        stop.set()
        thread.join()
    found = {**figures(taken), "seconds": monotonic() - begun, "load": machine()["load"][0]}
    print(f"{what:32}" + ", ".join(f"{name} {figure:.1f}" for name, figure in found.items()))
    return found


def written(url: str, client: httpx.Client, seconds: float) -> dict[str, Any]:
    """Latencies of a writer alone, and beside the registration and the deletion of 100,000 queries."""
    large = {"name": "large", "spec": spec(initial=MANY, budget=MANY)}

    def register() -> None:
        client.post("/v1/surrogates", json=large).raise_for_status()
        while client.get("/v1/surrogates/large").json()["queries"]["pending"] < MANY:
            sleep(0.5)

    return {
        "alone": beside(url, "alone", partial(sleep, seconds)),
        "registering": beside(url, "registering", register),
        "deleting": beside(url, "deleting", lambda: client.delete("/v1/surrogates/large").raise_for_status()),
    }


def main() -> None:
    made = parser(__doc__)
    made.add_argument("--each", type=int, default=EACH, help="clients of each kind")
    made.add_argument("--seconds", type=float, default=SECONDS, help="of each measurement")
    made.add_argument("--postgresql", action="store_true", help="a PostgreSQL of its own instead of SQLite")
    made.add_argument("--writers", action="store_true", help="a client that writes, instead of /healthz")
    options = started(made)
    tokens = ",".join(f"{role}:{token}" for role, token in TOKENS.items())
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory()))
        database: tuple[str, ...] = ()
        if options.postgresql:
            database = ("--database", stack.enter_context(running_postgresql()).new_database())
        server = stack.enter_context(running_server(folder, *database, SURROGYM_TOKENS=tokens))
        client = stack.enter_context(httpx.Client(base_url=server.url, headers=ADMIN, timeout=300))
        client.post("/v1/surrogates", json={"name": NAME, "spec": spec(initial=2, budget=2)}).raise_for_status()
        client.patch(f"/v1/surrogates/{NAME}", json={"paused": True}).raise_for_status()
        if options.writers:
            found = written(server.url, client, options.seconds)
        else:
            found = measured(server.url, server.process.pid, options.each, options.seconds)
    name = "writers" if options.writers else "waiters"
    write(options.out, f"{name}_postgresql" if options.postgresql else name, found)


if __name__ == "__main__":
    main()
