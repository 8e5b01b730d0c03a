"""The worker: it claims jobs from the server, runs them, and sends their results."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from surrogym_client.errors import SurrogymClientError
from surrogym_client.runtime.versions import missing
from surrogym_client.transport import HttpSurrogate
from surrogym_client.transport.api import Api
from surrogym_client.transport.connection import AWAY
from surrogym_sampler.original.errors import OriginalError
from surrogym_sampler.queries.settings import worker_name
from surrogym_sampler.queries.worker import PATIENCE
from surrogym_shared import wire
from surrogym_trainer.work.outbox import Outbox, Waiting, in_one_line
from surrogym_trainer.work.reporter import Reporter, Stand
from surrogym_trainer.work.tasks import Environment, Gathered, run_episodes, train
from surrogym_trainer.work.words import words_of_task

STOPPED = "the worker was stopped"
CANCELLED = "cancelled by a person"

T = TypeVar("T")

__all__ = ["Environment", "Worker", "WorkerReport", "WorkerSettings"]


@dataclass(frozen=True)
class WorkerSettings:
    """Settings of a worker.

    Attributes:
        name: name of the worker.
        folder: folder for policies and results that wait to be sent.
        wait_seconds: seconds that a claim waits for a job.
        lease_seconds: seconds for which a claimed job is reserved for this worker.
        once: whether to stop after the first job.
    """

    name: str = field(default_factory=worker_name)
    folder: Path = Path("work")
    wait_seconds: float = 20.0
    lease_seconds: float = wire.JOB_LEASE_SECONDS
    once: bool = False


@dataclass(frozen=True)
class WorkerReport:
    """The numbers of jobs by how they ended."""

    done: int = 0
    failed: int = 0
    cancelled: int = 0


class Worker:
    """Runs the trainings and evaluations of one surrogate that people request from the server.

    A job's task consists of numbers and of words from fixed lists. The code and the environment are the worker's own.

    A policy is written to a file before it is sent. If the server can't be reached, the worker waits for it, and sends
    the result later, also after a restart with the same folder.

    Args:
        api: the connection to the server.
        surrogate: name of the surrogate.
        settings: name, folder, and when to stop.
        environment: the original environment to evaluate in; None only trains.
        token: access token of the sessions in which policies learn; the default is that of ``Api``.
        tell: called with a sentence about each job.
        show: called with the progress of a job each time it changes.
    """

    def __init__(
        self,
        api: Api,
        surrogate: str,
        settings: WorkerSettings | None = None,
        environment: Environment | None = None,
        token: str | None = None,
        tell: Callable[[str], None] = lambda _: None,
        show: Callable[[Stand], None] = lambda _: None,
    ) -> None:
        self._api = api
        self._surrogate = surrogate
        self._settings = settings or WorkerSettings()
        self._environment = environment
        self._token = token
        self._tell = tell
        self._show = show
        self._outbox = Outbox(self._settings.folder, tell)
        self._counts: dict[wire.JobEnd, int] = {"done": 0, "failed": 0, "cancelled": 0}

    def run(self) -> WorkerReport:
        """Run jobs until Ctrl-C, or only the first one with the setting ``once``.

        Raises:
            ServerUnreachable, Unavailable: the server could not be reached for longer than ``PATIENCE``.
            UnknownSurrogate: the surrogate was deleted.
            KeyboardInterrupt: Ctrl-C was pressed. The best policy of a running training was kept, and sent if the
                server answered.
        """
        while True:
            job = self._patiently(self._next)
            if job is not None:
                self._work(job)
                if self._settings.once:
                    return self.report()

    def report(self) -> WorkerReport:
        """Return the numbers of jobs so far, by how they ended."""
        return WorkerReport(**self._counts)

    def _next(self) -> wire.LeasedJob | None:
        """Send the results that wait in the folder, and claim the next job."""
        self._outbox.send(self._api)
        s = self._settings
        return self._api.jobs.claim(
            self._surrogate,
            s.name,
            most_episodes=0 if self._environment is None else self._environment.most_episodes,
            reference=self._environment is not None and self._environment.reference is not None,
            wait_seconds=s.wait_seconds,
            lease_seconds=s.lease_seconds,
        )

    def _work(self, job: wire.LeasedJob) -> None:
        """Run one job, and send its result."""
        self._tell(f"job {job.id}: {words_of_task(job.task)}")
        gathered, stopped = Gathered(), False
        status: wire.JobEnd = "done"
        error: str | None = None
        with Reporter(self._api, self._surrogate, job, self._show) as reporter:
            try:
                self._do(job, reporter, gathered)
            except KeyboardInterrupt:
                stopped = not (reporter.cancelled or reporter.taken)
                status, error = "cancelled", STOPPED if stopped else CANCELLED
            except Exception as failure:  # a failing job must not end the worker
                status, error = "failed", in_one_line(_words(failure))
            reporter.storing()
            self._hand_in(job, reporter, gathered, status, error)
            if stopped:
                self._send_once()
                raise KeyboardInterrupt
            self._patiently(lambda: self._outbox.send(self._api))

    def _do(self, job: wire.LeasedJob, reporter: Reporter, gathered: Gathered) -> None:
        api, name, folder = self._api, self._surrogate, self._settings.folder
        if isinstance(job.task, wire.TrainTask):
            stamp = time.strftime("%Y%m%d-%H%M%S")
            out = folder / f"{name}-job{job.id}-{stamp}.zip"
            with HttpSurrogate(api.url, name, self._token, retries=PATIENCE) as port:
                train(api, port, job.task, out, reporter, gathered)
        elif self._environment is None:
            raise ValueError("this worker has no environment to evaluate in: start it with --env")
        else:
            run_episodes(api, name, job.task, self._environment, folder, reporter, gathered)

    def _hand_in(
        self, job: wire.LeasedJob, reporter: Reporter, gathered: Gathered, status: wire.JobEnd, error: str | None
    ) -> None:
        if reporter.taken:
            kept = "" if gathered.policy is None else f"; its policy so far is in {gathered.policy}"
            self._tell(f"job {job.id} was ended, or given to another worker{kept}")
            if not gathered.steps:
                return
        if status == "cancelled" and isinstance(job.task, wire.TrainTask) and gathered.policy is None:
            error = f"{error}, before there was a policy"
        self._counts[status] += 1
        self._outbox.put(
            Waiting(
                surrogate=self._surrogate,
                job=job.id,
                lease_token=job.lease_token,
                status=status,
                error=error or gathered.lacks,
                policy=None if gathered.policy is None or reporter.taken else gathered.policy.name,
                version=gathered.version,
                video=None if gathered.video is None else gathered.video.name,
                evaluations=tuple(gathered.evaluations),
                steps=tuple(gathered.steps),
            )
        )

    def _send_once(self) -> None:
        """Send the results that wait in the folder, without waiting for a server that can't be reached."""
        try:
            self._outbox.send(self._api)
        except AWAY as error:
            self._tell(f"the result waits in {self._settings.folder} for the next start of the worker: {error}")

    def _patiently(self, request: Callable[[], T]) -> T:
        """Repeat a request until the server answers. Raises the request's error after ``PATIENCE``."""
        delays: Iterator[float] = PATIENCE.delays()
        while True:
            try:
                return request()
            except AWAY:
                pause = next(delays, None)
                if pause is None:
                    raise
                time.sleep(pause)


def _words(error: Exception) -> str:
    """Return why a job failed, as a command would print it."""
    match error:
        case ModuleNotFoundError(name=str(name)):
            return missing(name.partition(".")[0]) or str(error)
        case SurrogymClientError() | OriginalError() | ValueError():
            return str(error)
        case _:
            return f"{type(error).__name__}: {error}"
