"""The part of the storage port for jobs: records, and laws that every adapter is tested for.

A job asks a trainer worker to train or to evaluate a policy. It is queued, running, done, failed or cancelled. A worker
runs it under a lease, as a sampler answers a query: the lease ends by the database's clock, and each report renews it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Literal

from surrogym_server.storage.records import JSON

JobKind = Literal["train", "evaluate"]
JobStatus = Literal["queued", "running", "done", "failed", "cancelled"]
JobEnd = Literal["done", "failed", "cancelled"]

MAX_JOBS = 100  # ended jobs of a surrogate; older ones are removed
MAX_OPEN = 20  # jobs of a surrogate that are queued or running
MAX_RUNS = 3  # runs of a training whose workers fall silent; an evaluation has one: it may move a machine
SILENT = "its worker fell silent, and its lease ended"


@dataclass(frozen=True)
class NewJob:
    """A job to queue. ``episodes`` is the number of real episodes that it takes: 0 for a training."""

    kind: JobKind
    task: JSON
    episodes: int = 0


@dataclass(frozen=True)
class JobProgress:
    """Progress of a job: ``state``, which a list shows, and the ``curve`` so far. Both replace the earlier ones."""

    state: JSON = field(default_factory=dict)
    curve: list[JSON] = field(default_factory=list)


@dataclass(frozen=True)
class JobResult:
    """Result of a job: how it ended, the version of its policy, and the number of its evaluation, if there are any."""

    status: JobEnd
    error: str | None = None
    version: int | None = None
    evaluation: int | None = None


@dataclass(frozen=True)
class JobRecord:
    """A stored job."""

    id: int
    kind: JobKind
    task: JSON
    status: JobStatus
    cancelling: bool  # running, and its worker is asked to stop
    created_at: float
    begun: float | None  # when its last worker began
    finished_at: float | None
    worker: str | None  # the last one to claim it
    attempts: int
    state: JSON
    error: str | None
    version: int | None
    evaluation: int | None
    curve: list[JSON] = field(default_factory=list, repr=False)  # empty in a list


@dataclass(frozen=True)
class LeasedJob:
    """A job that a worker has claimed, with the token of its lease."""

    id: int
    task: JSON
    attempt: int  # 1 for the first lease of this job
    token: str


class Jobs(ABC):
    """Jobs of a surrogate, and their leases.

    A training whose lease ends is queued again, and failed after ``MAX_RUNS``. An evaluation whose lease ends is
    failed, because its real steps may have been taken. A job that was to be cancelled is then cancelled.

    A worker proves its lease by the token. It may continue although the lease has ended, as long as no other worker has
    claimed the job and nobody has cancelled it: its next report makes the job running again, and its result counts.

    An operation on a job that does not exist raises ``UnknownJob``.
    """

    @abstractmethod
    def add(self, name: str, new: NewJob, *, key: str | None = None) -> int:
        """Queue a job, and return its id. The oldest ended jobs beyond ``MAX_JOBS`` are removed.

        Raises:
            Overloaded: there are ``MAX_OPEN`` jobs that are queued or running.
        """

    @abstractmethod
    def claim(
        self, name: str, worker: str, most_episodes: int, seconds: float, *, reference: bool = False
    ) -> LeasedJob | None:
        """Lease the oldest queued job of at most ``most_episodes`` real episodes to one caller. None if there is none.

        Jobs that ask for a reference controller are leased only to a worker that has one.

        Expired leases are ended first. A new lease clears the progress of the one before.
        """

    @abstractmethod
    def report(self, name: str, id: int, token: str, seconds: float, progress: JobProgress | None) -> bool:
        """Extend the lease to ``seconds`` from now, and store the progress. Returns whether the worker is to stop.

        Raises:
            LeaseExpired: the job has ended, or another worker has it.
        """

    @abstractmethod
    def finish(self, name: str, id: int, token: str, result: JobResult) -> JobRecord:
        """End a job. A repeat is harmless, and changes nothing.

        Raises:
            LeaseExpired: another worker has the job, or it was cancelled before a worker had it again.
        """

    @abstractmethod
    def cancel(self, name: str, id: int) -> JobRecord:
        """Cancel a queued job at once, and ask the worker of a running one to stop. A job that has ended stays."""

    @abstractmethod
    def get(self, name: str, id: int) -> JobRecord:
        """Return a job with its curve."""

    @abstractmethod
    def list(self, name: str) -> list[JobRecord]:
        """Return all jobs, newest first, without their curves."""

    @abstractmethod
    def sweep_expired(self) -> int:
        """End the expired leases of all surrogates, and return how many there were.

        A lease with more time left than it was given, because the clock was set back, gets that time from now.
        """
