"""Records of jobs.

A job asks a trainer worker to train or to evaluate a policy. It is queued, running, done, failed or cancelled. A worker
runs it under a lease, as a sampler answers a query: the lease ends by the database's clock, and each report renews it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from surrogym_server.storage.records import JSON
from surrogym_shared.states import JobEnd, JobKind, JobStatus

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
