"""Records of jobs.

A job is a request to train or to evaluate a policy. It is queued, running, done, failed or cancelled. A trainer worker
runs it under a lease, which ends by the database's clock, and which each report of the worker renews.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from surrogym_server.storage.records import JSON
from surrogym_shared.states import JobEnd, JobKind, JobStatus

MAX_JOBS = 100  # largest number of ended jobs that are kept for a surrogate
MAX_OPEN = 20  # largest number of queued and running jobs of a surrogate
# If workers disappear, a training is begun at most this many times; an evaluation once, because it may move a machine.
MAX_RUNS = 3
SILENT = "its worker fell silent, and its lease ended"


@dataclass(frozen=True)
class NewJob:
    """A job to queue. ``episodes`` is the number of real episodes of an evaluation, and 0 for a training."""

    kind: JobKind
    task: JSON
    episodes: int = 0


@dataclass(frozen=True)
class JobProgress:
    """Progress of a job: its present ``state``, and its learning ``curve`` so far. Both replace the state and the curve
    of earlier reports."""

    state: JSON = field(default_factory=dict)
    curve: list[JSON] = field(default_factory=list)


@dataclass(frozen=True)
class JobResult:
    """Result of a job: its status at the end, the version of the policy, and the id of the evaluation, if any."""

    status: JobEnd
    error: str | None = None
    version: int | None = None
    evaluation: int | None = None


@dataclass(frozen=True)
class JobRecord:
    """A stored job, with its status, its lease and its progress."""

    id: int
    kind: JobKind
    task: JSON
    status: JobStatus
    cancelling: bool  # whether the job is running and its worker has been asked to stop
    created_at: float
    begun: float | None  # time of the last claim by a worker; None before the first
    finished_at: float | None
    worker: str | None  # name of the worker that claimed the job last
    attempts: int
    state: JSON
    error: str | None
    version: int | None
    evaluation: int | None
    # Learning curve of a training so far; left empty in lists of jobs.
    curve: list[JSON] = field(default_factory=list, repr=False)


@dataclass(frozen=True)
class LeasedJob:
    """A job that a worker has claimed, with the token of its lease."""

    id: int
    task: JSON
    attempt: int  # number of this lease among the leases of the job: 1, 2, ...
    token: str
