"""A worker that is killed frees its training for the next one; a server that is killed gets the result later."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from support.server import RestartingServer
from support.teaching import teach
from surrogym_client.transport import Api, Retries
from surrogym_sampler.original.classic import pendulum
from surrogym_shared import wire
from surrogym_trainer.work.worker import Worker, WorkerReport, WorkerSettings

NAME = "pendulum"
LEASE = 2.0
TASK = wire.TrainTask(kind="train", algorithm="fastppo", steps=60_000, audit=False)
WORKER = """
import sys
from pathlib import Path
from surrogym_client.transport import Api
from surrogym_trainer.work.worker import Worker, WorkerSettings
Worker(Api(sys.argv[1]), "pendulum", WorkerSettings("killed", Path(sys.argv[2]), lease_seconds=2)).run()
"""

pytestmark = pytest.mark.timeout(600)


@pytest.fixture
def server(tmp_path: Path) -> Iterator[RestartingServer]:
    running = RestartingServer(tmp_path)
    with Api(running.url) as api:
        teach(api, NAME, pendulum(), queries=12)
    yield running
    if running.process.poll() is None:
        running.stop()


def until(happened: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 120
    while not happened():
        assert time.monotonic() < deadline, "it never happened"
        time.sleep(0.05)


def test_the_training_job_of_a_killed_worker_is_done_by_the_next_worker(server: RestartingServer, tmp_path: Path):
    with Api(server.url) as api:
        id = api.jobs.add(NAME, TASK).id
        command = [sys.executable, "-c", WORKER, server.url, str(tmp_path / "killed")]
        process = subprocess.Popen(command, env=os.environ | {"OMP_NUM_THREADS": "1"})
        until(lambda: len(api.jobs.get(NAME, id).curve) > 0)
        process.kill()
        process.wait()
        report = Worker(api, NAME, WorkerSettings("next", tmp_path / "next", lease_seconds=LEASE, once=True)).run()
        job = api.jobs.get(NAME, id)
        assert report == WorkerReport(done=1)
        assert (job.status, job.worker, job.attempts, job.error) == ("done", "next", 2, None)
        assert [policy.version for policy in api.policies.list(NAME)] == [job.version] == [1]


def test_a_worker_delivers_its_result_after_a_server_outage_longer_than_the_lease(
    server: RestartingServer, tmp_path: Path
):
    reports: list[WorkerReport] = []

    def run() -> None:
        with Api(server.url, retries=Retries(seconds=60)) as own:
            settings = WorkerSettings("patient", tmp_path / "work", lease_seconds=LEASE, once=True)
            reports.append(Worker(own, NAME, settings).run())

    with Api(server.url) as api:
        id = api.jobs.add(NAME, TASK).id
        thread = threading.Thread(target=run)
        thread.start()
        until(lambda: len(api.jobs.get(NAME, id).curve) > 0)
        server.stop(signal.SIGKILL)
        time.sleep(2 * LEASE)
        server.start()
        thread.join(120)
    assert reports == [WorkerReport(done=1)]
    with Api(server.url) as api:
        job = api.jobs.get(NAME, id)
        assert (job.status, job.worker, job.error) == ("done", "patient", None)
        assert job.version == 1
    assert list((tmp_path / "work").glob("*.waiting.json")) == []
