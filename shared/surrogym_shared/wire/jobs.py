"""Wire models of jobs for trainer workers: tasks, progress and results."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from surrogym_shared.patterns import POLICY, VISIBLE
from surrogym_shared.states import JobEnd as JobEnd
from surrogym_shared.states import JobStatus as JobStatus
from surrogym_shared.wire.base import LEASE_SECONDS, Key, Measured, Reply, Request

MAX_JOB_EPISODES = 1_000  # most real episodes of an evaluation
MAX_JOB_STEPS = 10_000_000  # most virtual steps of a training
MAX_JOB_POINTS = 200  # most points of a training's curve

JobAlgorithm = Literal["ppo", "fastppo", "a2c", "sac", "td3", "ddpg", "dqn", "cmaes"]
JobPreset = Literal["default", "quick"]
JobStage = Literal["preparing", "training", "auditing", "evaluating", "storing"]

Count = Annotated[int, Field(ge=0, le=2**53)]
Seed = Annotated[int, Field(ge=0, lt=2**31)]
Share = Annotated[float, Field(ge=0, le=1)]
Version = Annotated[int, Field(ge=1, le=2**31 - 1)]
Number = Annotated[int, Field(ge=1, le=2**63 - 1)]
Said = Annotated[str, Field(max_length=2_000, pattern=VISIBLE)]
LeaseSeconds = Annotated[float, Field(gt=0, le=3_600)]


class TrainTask(Request):
    """Training of a policy, as by ``surrogym train``."""

    kind: Literal["train"]
    algorithm: JobAlgorithm | None = Field(
        default=None, description="policy search; null: the one that ``surrogym train`` would choose"
    )
    steps: Annotated[int, Field(ge=1, le=MAX_JOB_STEPS)] | None = Field(
        default=None, description="most virtual steps; null: as many as the algorithm suggests"
    )
    preset: JobPreset = Field(
        default="default",
        description="``default``, or ``quick`` for a trial: a quarter of the steps that the algorithm suggests, "
        "never prolonged",
    )
    seed: Seed = Field(default=0, description="seed of the training")
    audit: bool = Field(
        default=True,
        description="whether to audit the policy by a few real steps, if a sampler is connected. If the audit "
        "fails, the training takes further real steps of the budget",
    )

    @model_validator(mode="after")
    def _one_length(self) -> TrainTask:
        if self.preset == "quick" and self.steps is not None:
            raise ValueError("expected steps or preset quick, got both: leave one out")
        return self


class EvaluateTask(Request):
    """Evaluation of a stored policy by real episodes in the worker's environment, as by ``surrogym evaluate``."""

    kind: Literal["evaluate"]
    policy: Annotated[str, Field(pattern=POLICY)] = Field(
        default="latest", description="version or alias of the policy, or ``latest``"
    )
    episodes: Annotated[int, Field(ge=1, le=MAX_JOB_EPISODES)] = Field(
        default=100, description="number of real episodes of the policy"
    )
    first_seed: Seed = Field(
        default=10_000, description="reset seed of the first episode; each further episode takes the next seed"
    )
    wide: bool = Field(default=False, description="whether to start anywhere in the sampling range")
    compare: Literal["zero", "random"] | None = Field(
        default=None,
        description="also run the same starts without the policy, with an action of zero or with random actions; "
        "null: don't",
    )
    reference: bool = Field(
        default=False,
        exclude_if=lambda value: not value,  # omitted if false, because older workers refuse the field
        description="also run the same starts with the reference controller that the worker was started with",
    )
    video: bool = Field(
        default=False,
        exclude_if=lambda value: not value,
        description="draw the best, the median and the worst episode into a video of the policy",
    )

    @model_validator(mode="after")
    def _within_limit(self) -> EvaluateTask:
        if self.real_episodes > MAX_JOB_EPISODES:
            raise ValueError(
                f"expected at most {MAX_JOB_EPISODES} real episodes, those of the controllers to compare with "
                "included, got "
                f"{self.real_episodes}"
            )
        return self

    @property
    def real_episodes(self) -> int:
        """Number of real episodes, of the policy and of its comparisons together."""
        return self.episodes * (1 + (self.compare is not None) + self.reference)


Task = Annotated[TrainTask | EvaluateTask, Field(discriminator="kind")]


class AddJob(Request):
    """Request to queue a job for a trainer worker."""

    task: Task = Field(description="training or evaluation to run")
    idempotency_key: Key | None = Field(default=None, description="a repeat with the same key queues no second job")


class ClaimJob(Request):
    """Request of a trainer worker for a job, which it holds under a lease."""

    worker: Key = Field(description="name of the worker, shown to people")
    most_episodes: Annotated[int, Field(ge=0, le=MAX_JOB_EPISODES)] = Field(
        default=0,
        description="most real episodes that an evaluation for this worker may have; 0: it takes only trainings",
    )
    reference: bool = Field(
        default=False,
        exclude_if=lambda offered: not offered,  # omitted if false, because older servers refuse the field
        description="whether the worker has a reference controller; evaluations that ask for one go to no other",
    )
    wait_seconds: Annotated[float, Field(ge=0, le=60)] = Field(
        default=0.0, description="seconds that the reply may wait for a job; 0: reply at once"
    )
    lease_seconds: LeaseSeconds = Field(
        default=LEASE_SECONDS, description="seconds until the lease ends, unless a report renews it"
    )


class LeasedJob(Reply):
    """A job that a worker has claimed, with its lease."""

    id: int = Field(description="id of the job")
    attempt: int = Field(description="1 for the first lease of this job")
    lease_token: str = Field(description="token of the lease, for reports and for the end of the job")
    lease_seconds: float = Field(description="seconds from this reply until the lease ends, unless a report renews it")
    task: Task = Field(description="training or evaluation to run")


class ClaimedJob(Reply):
    """Reply to a worker's request for a job."""

    job: LeasedJob | None = Field(description="the leased job; null if none came in time")


class JobPoint(Request):
    """One point of a training's curve."""

    steps: Count = Field(description="virtual steps so far")
    imagined_return: Measured | None = Field(
        default=None, description="imagined return of the policy at this point; null if it was not measured"
    )


class JobState(Request):
    """Progress of a job, as its worker reports it."""

    stage: JobStage = Field(description="stage that the job is in")
    share: Share = Field(default=0.0, description="share of this stage that is done, between 0 and 1")
    steps: Count | None = Field(
        default=None, description="virtual steps of the training so far; null outside of a training"
    )
    total_steps: Count | None = Field(
        default=None, description="virtual steps that the training will take, as planned now; null if unknown"
    )
    imagined_return: Measured | None = Field(
        default=None, description="imagined return of the policy at its last check"
    )
    curve: list[JobPoint] = Field(
        default=[],
        max_length=MAX_JOB_POINTS,
        description="all points of the training's curve so far; they replace those of the last report",
    )


class ReportJob(Request):
    """Heartbeat of a worker, with the progress of its job. It renews the lease for ``lease_seconds``."""

    lease_token: Key = Field(description="token of the lease")
    lease_seconds: LeaseSeconds = Field(default=LEASE_SECONDS, description="seconds from now until the lease ends")
    state: JobState | None = Field(default=None, description="progress of the job; null: as in the last report")


class ReportedJob(Reply):
    """Reply to a worker's report on its job."""

    cancel: bool = Field(
        description="whether a person cancelled the job: the worker then stops, and keeps the best policy so far"
    )


class FinishJob(Request):
    """Report of a worker that its job has ended."""

    lease_token: Key = Field(description="token of the lease")
    status: JobEnd = Field(description="how the job ended")
    error: Said | None = Field(default=None, description="why it failed, for people; null if it did not")
    version: Version | None = Field(
        default=None, description="version of the policy that was stored or evaluated; null if there is none"
    )
    evaluation: Number | None = Field(default=None, description="id of the stored evaluation; null if there is none")


class JobView(Reply):
    """A job with its progress and its result, as people see it."""

    id: int = Field(description="id of the job")
    task: Task = Field(description="training or evaluation")
    status: JobStatus = Field(description="queued, running, or how it ended")
    cancelling: bool = Field(
        description="whether a person cancelled the running job, and its worker has not ended it yet"
    )
    created_at: float = Field(description="when it was queued, in seconds since 1970, by the server's clock")
    begun_at: float | None = Field(description="when its last worker began; null if none has")
    finished_at: float | None = Field(description="when it ended; null before")
    worker: str | None = Field(description="name of the last worker that claimed it")
    attempts: int = Field(description="number of leases so far")
    stage: JobStage | None = Field(default=None, description="stage that it is in; null before the first report")
    share: float = Field(default=0.0, description="share of this stage that is done")
    steps: int | None = Field(default=None, description="virtual steps so far")
    total_steps: int | None = Field(default=None, description="virtual steps that are planned")
    imagined_return: float | None = Field(default=None, description="imagined return of the policy at its last check")
    error: str | None = Field(description="why it failed, or why its last lease ended")
    version: int | None = Field(description="version of the policy that was stored or evaluated")
    evaluation: int | None = Field(description="id of the stored evaluation")


class JobDetail(JobView):
    """A job with the curve of its training."""

    curve: list[JobPoint] = Field(description="points of the training's curve so far")


class WorkerView(Reply):
    """A connected trainer worker."""

    name: str = Field(description="name of the worker")
    most_episodes: int = Field(
        description="most real episodes that an evaluation for this worker may have; 0: it takes only trainings"
    )
    reference: bool = Field(default=False, description="whether it has a reference controller")


class JobList(Reply):
    """The jobs of a surrogate, and its connected workers."""

    jobs: list[JobView] = Field(description="newest first")
    workers: list[WorkerView] = Field(description="trainer workers that claimed or reported within the last minute")
