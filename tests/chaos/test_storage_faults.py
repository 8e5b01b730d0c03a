"""A full disk, a database that another program keeps, a PostgreSQL that restarts: refused in words, nothing
acknowledged is lost, and all goes on without a restart of the server. Open sessions step through it."""

from __future__ import annotations

import os
import resource
import shutil
import sqlite3
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import psycopg
import pytest

from support.chaos import times
from support.postgresql import running_postgresql
from support.server import ServerProcess, running_server
from support.teaching import teach
from surrogym_client.transport import Api, HttpSurrogate, Retries
from surrogym_sampler.original.classic import pendulum
from surrogym_server.storage.sql.database import BUSY_SECONDS
from surrogym_shared.wire import OpenSession

ROUNDS = times(short=1, full=10)
LANES = 4
MANY = 2_000  # samples, more than the room that is left
MIB = 1024 * 1024
SECONDS = 60.0

pytestmark = pytest.mark.timeout(1_800)


Fault = Callable[[ServerProcess], AbstractContextManager[None]]


@dataclass
class Place:
    """Where a server keeps its data, and what can happen to it there."""

    database: str
    faults: list[Fault]
    one_row: Fault | None = None  # the one that stops the writes of one surrogate alone


@contextmanager
def in_a_file(folder: Path) -> Iterator[Place]:
    path = str(folder / "surrogym.db")

    @contextmanager
    def limited(server: ServerProcess) -> Iterator[None]:
        """Its files can't grow beyond a size: what a quota does, and no privilege is needed for it."""
        pid = server.process.pid
        before = resource.prlimit(pid, resource.RLIMIT_FSIZE)
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (MIB // 4, before[1]))
        try:
            yield
        finally:
            resource.prlimit(pid, resource.RLIMIT_FSIZE, before)

    @contextmanager
    def locked(_: ServerProcess) -> Iterator[None]:
        """Another program has begun a transaction and does not end it."""
        with closing(sqlite3.connect(path, isolation_level=None)) as other:
            other.execute("BEGIN EXCLUSIVE")
            yield

    yield Place(path, [limited, locked])


@contextmanager
def on_a_small_disk(folder: Path) -> Iterator[Place]:
    disk = folder / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=8m", "none", str(disk)]
    if os.geteuid() or not shutil.which("mount") or subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("a file system can't be mounted here; the limit of a file's size stands for it")

    @contextmanager
    def full(_: ServerProcess) -> Iterator[None]:
        """Not a byte is left on the file system."""
        ballast = disk / "ballast"
        with open(ballast, "wb", buffering=0) as file, suppress(OSError):
            while file.write(bytes(4_096)):
                pass
        try:
            yield
        finally:
            ballast.unlink()

    try:
        yield Place(str(disk / "surrogym.db"), [full])
    finally:
        subprocess.run(["umount", str(disk)], check=True)


@contextmanager
def in_postgresql(_: Path) -> Iterator[Place]:
    with running_postgresql() as postgresql:
        url = postgresql.new_database()

        @contextmanager
        def locked(_: ServerProcess) -> Iterator[None]:
            """Somebody at a prompt holds the surrogate's row."""
            with closing(psycopg.connect(url)) as other:
                other.execute("SELECT * FROM surrogates FOR UPDATE")
                yield

        @contextmanager
        def restarted(_: ServerProcess) -> Iterator[None]:
            """It crashes, and is started again after a while."""
            postgresql.stop()
            try:
                yield
            finally:
                postgresql.start()

        yield Place(url, [locked, restarted], one_row=locked)


@pytest.fixture(params=[in_a_file, on_a_small_disk, pytest.param(in_postgresql, marks=pytest.mark.postgresql)])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Place]:
    with request.param(tmp_path) as made:
        yield made


class Stepping:
    """Steps one session from a thread, without a single retry."""

    def __init__(self, url: str) -> None:
        self.steps = 0
        self._port = HttpSurrogate(url, "pendulum", retries=Retries(seconds=0))
        self._session = self._port.open(OpenSession(num_envs=LANES, seed=0)).id
        self._port.reset(self._session)
        self._ending = threading.Event()
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._work)

    def __enter__(self) -> Stepping:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.set()
        self._thread.join(60)
        self._port.disconnect()

    def go_on(self, steps: int = 20) -> None:
        """Return after so many more steps; raises what has ended them."""
        wanted, deadline = self.steps + steps, time.monotonic() + SECONDS
        while self.steps < wanted:
            if self._error is not None:
                raise self._error
            assert time.monotonic() < deadline, "sessions no longer step"
            time.sleep(0.01)

    def _work(self) -> None:
        actions = np.random.default_rng(0).uniform(-2, 2, (LANES, 1))
        try:
            while not self._ending.is_set():
                self._port.step(self._session, actions)
                self.steps += 1
        except Exception as error:
            self._error = error


class Samples:
    """Adds samples by hand and remembers which were acknowledged: the reward of each is its number."""

    def __init__(self, client: httpx.Client) -> None:
        self.acknowledged: dict[int, float] = {}
        self.next = 0.0
        self._client = client

    def add(self) -> httpx.Response:
        """The next one, or again the one that was refused."""
        sample: dict[str, Any] = {"coordinates": [0.0, 0.0], "action": [0.0], "next_coordinates": [0.0, 0.0]}
        body = {
            "sampler": "hand",
            "idempotency_key": f"sample {self.next}",
            "samples": [{**sample, "reward": self.next, "terminated": False}],
        }
        response = self._client.post("/v1/surrogates/pendulum/add_sample", json=body)
        if response.is_success:
            [id] = response.json()["sample_ids"]
            self.acknowledged[id] = self.next
            self.next += 1
        return response

    def add_until(self, success: bool) -> httpx.Response:
        deadline = time.monotonic() + SECONDS
        for _ in range(MANY):
            response = self.add()
            if response.is_success is success:
                return response
            assert time.monotonic() < deadline
            if not response.is_success:
                time.sleep(0.1)
        raise AssertionError("the fault was not noticed")


def judge_refusal(response: httpx.Response) -> None:
    assert response.status_code == 503, response.text
    assert float(response.headers["retry-after"]) > 0
    problem = response.json()
    assert problem["code"] == "unavailable"
    assert problem["detail"].startswith("the database can't be used now: ")


def wait_for_readiness(client: httpx.Client, status: int) -> None:
    """Wait until ``/readyz`` answers so; no answer may take as long as the database is waited for."""
    deadline = time.monotonic() + SECONDS
    while (answer := client.get("/readyz")).status_code != status:
        assert time.monotonic() < deadline, answer.text
        assert answer.elapsed.total_seconds() < BUSY_SECONDS
        time.sleep(0.1)


def test_the_server_logs_and_survives_a_storage_fault(place: Place, tmp_path: Path):
    with running_server(tmp_path, "--database", place.database) as server:
        with Api(server.url) as api:
            teach(api, "pendulum", pendulum(), queries=6)
            api.patch_surrogate("pendulum", paused=True)  # so that no fit is due meanwhile
            with httpx.Client(base_url=server.url, timeout=SECONDS) as client, Stepping(server.url) as stepping:
                samples = Samples(client)
                for fault in place.faults * ROUNDS:
                    samples.add_until(success=True)
                    with fault(server):
                        judge_refusal(samples.add_until(success=False))
                        wait_for_readiness(client, 200 if fault is place.one_row else 503)
                        stepping.go_on()
                    samples.add_until(success=True)
                    wait_for_readiness(client, 200)
                    stepping.go_on()
            stored = {sample.id: sample.reward for sample in api.samples("pendulum") if sample.purpose == "manual"}
            assert stored == samples.acknowledged, "all of them, each once"
        assert "Traceback" not in server.log
