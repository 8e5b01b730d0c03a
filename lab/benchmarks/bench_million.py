"""What requests cost in a PostgreSQL database with 200 surrogates, a million samples and 1,000 open sessions.

A server of its own answers one client over HTTP. Meanwhile two owners renew and record 1,000 sessions in the database,
as hosts of a cluster do, and another client steps one of 1,000 more that are open in the server, 100 times a second.
The times of pages of 1,000 samples are divided as in ``bench_samples_page.py``, which shows what their slowest
hundredth waits for. The plan of each statement is written to a file.
"""

from __future__ import annotations

import random
import statistics
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import httpx
import numpy as np
import sqlalchemy as sa
from bench_samples_page import children, ran_and_waited, request, show, summary
from common import parser, started, write

from support.million import APART, FIRST, fill
from support.postgresql import running_postgresql
from support.server import running_server
from support.teaching import teach
from surrogym_client.transport import Api, HttpSurrogate
from surrogym_sampler.original.classic import pendulum
from surrogym_server.features.ray.store import Checkpoint, LiveSessions, SessionLease
from surrogym_server.storage.sql import Storage, open_storage
from surrogym_shared.wire import OpenSession

SURROGATES, SAMPLES, SESSIONS, CHECKPOINT = 200, 1_000_000, 1_000, 16_384
QUICK = (20, 20_000, 100)
TAUGHT, STEPS_A_SECOND = "taught", 100  # the surrogate of the server's sessions
LARGE = 156 * 1_000 * 2 * 8  # bytes of 156 lanes of 1,000 particles with two coordinates


def quantiles(seconds: list[float]) -> dict[str, float]:
    ordered = sorted(seconds)
    return {
        "ms median": 1e3 * statistics.median(ordered),
        "ms 99th": 1e3 * ordered[min(len(ordered) - 1, int(0.99 * len(ordered)))],
        "ms most": 1e3 * ordered[-1],
        "calls": len(ordered),
    }


def timed(call: Callable[[], Any], count: int) -> dict[str, float]:
    call()
    taken = []
    for _ in range(count):
        start = time.perf_counter()
        call()
        taken.append(time.perf_counter() - start)
    return quantiles(taken)


class Trainer(threading.Thread):
    """Opens sessions of one lane in the server and steps one of them at a time, at most ``STEPS_A_SECOND``."""

    def __init__(self, url: str, sessions: int) -> None:
        super().__init__(daemon=True)
        self.port, self.ending = HttpSurrogate(url, TAUGHT, transport="binary"), threading.Event()
        self.steps: list[float] = []
        self.sessions = [self.port.open(OpenSession(seed=seed)).id for seed in range(sessions)]
        for session in self.sessions:
            self.port.reset(session)

    def run(self) -> None:
        action = np.zeros((1, 1), dtype=np.float32)
        while not self.ending.wait(1 / STEPS_A_SECOND):
            start = time.perf_counter()
            self.port.step(random.choice(self.sessions), action)
            self.steps.append(time.perf_counter() - start)


class Hosts(threading.Thread):
    """Renews the leases of all sessions, and records 200 checkpoints, every 2 s or as often as it can."""

    def __init__(self, storage: Storage, sessions: int) -> None:
        super().__init__(daemon=True)
        self.live, self.sessions, self.ending = storage.part(LiveSessions), sessions, threading.Event()
        self.ids = [[f"session-{n}.{owner}" for n in range(owner, sessions, 2)] for owner in range(2)]
        self.renewals: list[float] = []
        self.records: list[float] = []

    def run(self) -> None:
        data = bytes(CHECKPOINT)
        while not self.ending.is_set():
            begun = time.perf_counter()
            for owner in range(2):
                start = time.perf_counter()
                self.live.renew(f"{owner} host", self.ids[owner], 1e6)
                self.renewals.append(time.perf_counter() - start)
            for number in random.sample(range(self.sessions), min(200, self.sessions)):
                start = time.perf_counter()
                self.live.record(
                    SessionLease(f"session-{number}.{number % 2}", f"{number % 2} host", 1), Checkpoint(1, data)
                )
                self.records.append(time.perf_counter() - start)
            self.ending.wait(max(0.0, 2.0 - (time.perf_counter() - begun)))


def page_of(names: list[str], samples: int, limit: int) -> str:
    """The path of a page somewhere in the samples of one of the surrogates."""
    number = random.randrange(len(names))
    after = APART * number + 1_000 + random.randrange(max(1, samples // len(names) - limit))
    return f"/v1/surrogates/{names[number]}/samples?limit={limit}&after={after}"


def requests(client: httpx.Client, names: list[str], samples: int, count: int) -> dict[str, dict[str, float]]:
    """The times of each kind of request."""

    def get(path: Callable[[], str]) -> Callable[[], Any]:
        return lambda: client.get(path()).raise_for_status()

    def name() -> str:
        return random.choice(names)

    def claim_and_answer() -> None:
        chosen = name()
        start = time.perf_counter()
        found = client.post(f"/v1/surrogates/{chosen}/queries:claim", json={"sampler": "one", "max_queries": 1}).json()
        claims.append(time.perf_counter() - start)
        for query in found["queries"]:
            sample = {
                "coordinates": query["coordinates"],
                "action": query["action"],
                "next_coordinates": query["coordinates"],
                "reward": 0.5,
                "terminated": False,
                "query_id": query["id"],
                "lease_token": query["lease_token"],
            }
            start = time.perf_counter()
            client.post(
                f"/v1/surrogates/{chosen}/add_sample", json={"sampler": "one", "samples": [sample]}
            ).raise_for_status()
            answers.append(time.perf_counter() - start)

    claims: list[float] = []
    answers: list[float] = []
    paths: dict[str, Callable[[], str]] = {
        "list of surrogates": lambda: "/v1/surrogates",
        "page of 100 surrogates": lambda: "/v1/surrogates?limit=100",
        "one surrogate": lambda: f"/v1/surrogates/{name()}",
        "page of 1,000 samples": lambda: page_of(names, samples, 1_000),
        "page of 100 samples": lambda: page_of(names, samples, 100),
        "metrics": lambda: "/metrics",
        "readiness": lambda: "/readyz",
    }
    found = {what: timed(get(path), count) for what, path in paths.items()}
    for _ in range(count):
        claim_and_answer()
    return {"claim": quantiles(claims[1:]), "answer": quantiles(answers[1:]), **found}


def of_storage(storage: Storage, names: list[str], count: int) -> dict[str, dict[str, float]]:
    """What servers ask without a request: once a second, or once a request of a session that moved."""
    live = storage.part(LiveSessions)
    calls: dict[str, Callable[[], Any]] = {
        "designs due": storage.designs.due,
        "designs without hope": storage.designs.hopeless,
        "end of expired leases": storage.queries.sweep_expired,
        "end of old sessions": lambda: live.sweep(3600.0),
        "who holds a session": lambda: live.holder("session-7.1"),
        "reward range": lambda: storage.samples.reward_range(random.choice(names)),
        "newest models": storage.models.newest,
    }
    return {what: timed(call, count) for what, call in calls.items()}


def of_large_checkpoint(storage: Storage, postmaster: int, count: int) -> dict[str, float]:
    """PostgreSQL's processor time for the checkpoint of a session with many particles."""
    data = random.Random(0).randbytes(LARGE)  # doubles of particles can't be compressed either
    lease, ran = SessionLease("session-7.1", "1 host", 1), []
    for number in range(count):
        before = {pid: ran_and_waited(pid)[0] for pid in children(postmaster)}
        storage.part(LiveSessions).record(lease, Checkpoint(number, data))
        ran.append(sum(max(0.0, ran_and_waited(pid)[0] - ms) for pid, ms in before.items()))
    return {"ms median": statistics.median(ran), "calls": count}


def plans(url: str, names: list[str]) -> list[str]:
    """The statements that only read, with their plans."""
    storage = open_storage(url)
    seen: dict[str, Any] = {}

    def note(connection: Any, cursor: Any, statement: str, parameters: Any, context: Any, many: bool) -> None:
        if statement.lstrip().upper().startswith(("SELECT", "WITH")) and not many:
            seen.setdefault(statement, parameters)

    sa.event.listen(sa.Engine, "before_cursor_execute", note)
    try:
        of_storage(storage, names, 1)
        storage.surrogates.summaries()
        storage.surrogates.summaries(limit=100)
        storage.surrogates.summary(names[0])
        storage.samples.page(names[0], 0, 1_000)
        storage.queries.list(names[0], ("pending",))
        storage.queries.claim(names[1], "planned", 4, 60.0)
    finally:
        sa.event.remove(sa.Engine, "before_cursor_execute", note)
        storage.close()
    engine = sa.create_engine(url.replace("postgresql://", "postgresql+psycopg://"))
    told = []
    with engine.begin() as connection:
        for statement, parameters in seen.items():
            if "pg_catalog" in statement or "alembic" in statement:
                continue
            explained = connection.exec_driver_sql(f"EXPLAIN (ANALYZE, BUFFERS) {statement}", parameters or None)
            lines = [row[0] for row in explained]
            told.append(f"{' '.join(statement.split())}\n" + "\n".join(f"    {line}" for line in lines))
        connection.rollback()
    engine.dispose()
    return told


def main() -> None:
    options = started(parser(__doc__))
    surrogates, samples, sessions = QUICK if options.quick else (SURROGATES, SAMPLES, SESSIONS)
    count = 20 if options.quick else 200
    with running_postgresql() as postgresql, TemporaryDirectory() as folder:
        url = postgresql.new_database()
        start = time.perf_counter()
        fill(url, surrogates, samples, sessions, CHECKPOINT)
        seconds = time.perf_counter() - start
        print(f"{surrogates} surrogates, {samples:,} samples and {sessions:,} sessions in {seconds:.0f} s")
        storage = open_storage(url)
        names = [FIRST, *(f"{FIRST}-{number}" for number in range(1, surrogates))]
        hosts = Hosts(storage, sessions)
        hosts.start()
        of_server = ("--log-level", "warning", "--database", url)
        with (
            running_server(Path(folder), *of_server, SURROGYM_MAX_SESSIONS=str(sessions)) as server,
            httpx.Client(base_url=server.url, timeout=120) as client,
        ):
            with Api(server.url) as api:
                teach(api, TAUGHT, pendulum(), queries=12)
            trainer = Trainer(server.url, sessions)
            trainer.start()
            report = requests(client, names, samples, count)
            path = partial(page_of, names, samples, 1_000)
            pages = [request(client, server.process.pid, postgresql.pid, path) for _ in range(5 * count)]
            parts = {f"{len(pages):,} pages": summary(pages)}
            trainer.ending.set()
            trainer.join()
        report |= of_storage(storage, names, max(10, count // 4))
        hosts.ending.set()
        hosts.join()
        report["step of a session"] = quantiles(trainer.steps)
        report |= {"renewal of half of the sessions": quantiles(hosts.renewals), "checkpoint": quantiles(hosts.records)}
        report["processor time, 2.5 MB checkpoint"] = of_large_checkpoint(storage, postgresql.pid, 20)
        for what, figures in report.items():
            print(f"{what:34}" + "  ".join(f"{key} {value:8.1f}" for key, value in figures.items()))
        show("ms of a page of 1,000 samples", parts)
        told = plans(url, names)
        storage.close()
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "million-plans.txt").write_text("\n\n".join(told))
    write(options.out, "million", {"requests": report, "pages": parts})


if __name__ == "__main__":
    main()
