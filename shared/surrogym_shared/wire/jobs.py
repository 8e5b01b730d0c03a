"""Wire models of jobs for trainer workers: tasks, progress and results."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from surrogym_shared.patterns import POLICY, VISIBLE
from surrogym_shared.states import JobEnd as JobEnd
from surrogym_shared.states import JobStatus as JobStatus
from surrogym_shared.wire.base import Key, Measured, Reply, Request

JOB_LEASE_SECONDS = 60.0  # default duration of a worker's lease of a job
MAX_JOB_EPISODES = 1_000  # largest number of real episodes of an evaluation
MAX_JOB_STEPS = 10_000_000  # largest number of virtual steps of a training
MAX_JOB_POINTS = 200  # largest number of points of a training's learning curve

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
        default=None, description="name of the training algorithm; null: the one that ``surrogym train`` would choose"
    )
    steps: Annotated[int, Field(ge=1, le=MAX_JOB_STEPS)] | None = Field(
        default=None, description="largest number of virtual steps; null: as many as the algorithm suggests"
    )
    preset: JobPreset = Field(
        default="default",
        description="``default``, or ``quick`` for a trial: a quarter of the steps that the algorithm suggests, "
        "and the training is never prolonged",
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
            raise ValueError("expected steps or the preset quick, which sets the steps, got both: leave one out")
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
    wide: bool = Field(
        default=False,
        description="whether each episode starts anywhere in the sampling ranges, not at the specified starts",
    )
    compare: Literal["zero", "random"] | None = Field(
        default=None,
        description="controller to compare with, which runs from the same starts: an action of ``zero``, or ``random`` "
        "actions; null: none",
    )
    reference: bool = Field(
        default=False,
        exclude_if=lambda value: not value,  # omitted if false, because older workers refuse the field
        description="whether the worker's reference controller runs from the same starts too, for comparison",
    )
    video: bool = Field(
        default=False,
        exclude_if=lambda value: not value,
        description="whether to store a video of the policy's best, median and worst episode",
    )

    @model_validator(mode="after")
    def _within_limit(self) -> EvaluateTask:
        if self.real_episodes > MAX_JOB_EPISODES:
            raise ValueError(
                f"expected at most {MAX_JOB_EPISODES} real episodes, including those of the controllers to compare "
                f"with, got {self.real_episodes}: reduce episodes, or compare with fewer controllers"
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
    """Request of a trainer worker to lease the next job that it accepts."""

    worker: Key = Field(description="name of the worker, shown to people")
    most_episodes: Annotated[int, Field(ge=0, le=MAX_JOB_EPISODES)] = Field(
        default=0,
        description="largest number of real episodes of an evaluation that the worker accepts; 0: trainings only",
    )
    reference: bool = Field(
        default=False,
        exclude_if=lambda offered: not offered,  # omitted if false, because older servers refuse the field
        description="whether the worker has a reference controller; only such a worker gets evaluations that need one",
    )
    wait_seconds: Annotated[float, Field(ge=0, le=60)] = Field(
        default=0.0, description="seconds that the reply may wait for a job; 0: reply at once"
    )
    lease_seconds: LeaseSeconds = Field(
        default=JOB_LEASE_SECONDS, description="seconds until the lease ends, unless a report renews the lease"
    )


class LeasedJob(Reply):
    """A job that a worker has claimed, with its lease."""

    id: int = Field(description="id of the job")
    attempt: int = Field(description="number of this lease among the leases of the job: 1, 2, ...")
    lease_token: str = Field(description="token of the lease, for reports and for the end of the job")
    lease_seconds: float = Field(
        description="seconds from this reply until the lease ends, unless a report renews the lease"
    )
    task: Task = Field(description="training or evaluation to run")


class ClaimedJob(Reply):
    """Reply to a worker's request for a job."""

    job: LeasedJob | None = Field(description="the leased job; null if none came in time")


class JobPoint(Request):
    """One point of a training's learning curve: virtual steps and imagined return."""

    steps: Count = Field(description="virtual steps so far")
    imagined_return: Measured | None = Field(
        default=None, description="imagined return of the policy at this point; null if it was not measured"
    )


class JobState(Request):
    """Progress of a job, as its worker reports it."""

    stage: JobStage = Field(description="present stage of the job")
    share: Share = Field(default=0.0, description="share of the present stage that is done, between 0 and 1")
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
        description="all points of the learning curve so far; they replace the points of earlier reports",
    )


class ReportJob(Request):
    """Report of a worker on the progress of its job, which extends the job's lease to ``lease_seconds`` from now."""

    lease_token: Key = Field(description="token of the lease")
    lease_seconds: LeaseSeconds = Field(default=JOB_LEASE_SECONDS, description="seconds from now until the lease ends")
    state: JobState | None = Field(
        default=None, description="progress of the job; null: unchanged since the last report"
    )


class ReportedJob(Reply):
    """Reply to a worker's report on its job."""

    cancel: bool = Field(
        description="whether a person cancelled the job; the worker then stops, and stores the best policy so far"
    )


class FinishJob(Request):
    """Report of a worker that its job has ended."""

    lease_token: Key = Field(description="token of the lease")
    status: JobEnd = Field(description="how the job ended")
    error: Said | None = Field(default=None, description="why the job failed, for people; null if it did not fail")
    version: Version | None = Field(
        default=None, description="version of the policy that was stored or evaluated; null if there is none"
    )
    evaluation: Number | None = Field(default=None, description="id of the stored evaluation; null if there is none")


class JobView(Reply):
    """A job with its progress and its result, as people see it."""

    id: int = Field(description="id of the job")
    task: Task = Field(description="training or evaluation")
    status: JobStatus = Field(description="whether the job is queued or running, or how it ended")
    cancelling: bool = Field(
        description="whether a person cancelled the running job, and its worker has not ended it yet"
    )
    created_at: float = Field(description="when the job was queued, in seconds since 1970, by the server's clock")
    begun_at: float | None = Field(
        description="when a worker claimed the job last, in seconds since 1970; null if none has"
    )
    finished_at: float | None = Field(description="when the job ended, in seconds since 1970; null before its end")
    worker: str | None = Field(description="name of the worker that claimed the job last; null if none has")
    attempts: int = Field(description="how often workers have leased the job so far")
    stage: JobStage | None = Field(default=None, description="present stage of the job; null before the first report")
    share: float = Field(default=0.0, description="share of the present stage that is done, between 0 and 1")
    steps: int | None = Field(default=None, description="virtual steps of the training so far")
    total_steps: int | None = Field(
        default=None, description="virtual steps that the training will take, as planned now"
    )
    imagined_return: float | None = Field(default=None, description="imagined return of the policy at its last check")
    error: str | None = Field(description="why the job failed, or why its last lease ended; null if neither happened")
    version: int | None = Field(description="version of the policy that the job stored or evaluated; null without one")
    evaluation: int | None = Field(description="id of the stored evaluation; null without one")


class JobDetail(JobView):
    """A job with the learning curve of its training."""

    curve: list[JobPoint] = Field(description="points of the learning curve so far, oldest first")


class WorkerView(Reply):
    """A connected trainer worker."""

    name: str = Field(description="name of the worker")
    most_episodes: int = Field(
        description="largest number of real episodes of an evaluation that the worker accepts; 0: trainings only"
    )
    reference: bool = Field(
        default=False, description="whether the worker has a reference controller, which some evaluations need"
    )


class JobList(Reply):
    """The jobs of a surrogate, and its connected workers."""

    jobs: list[JobView] = Field(description="jobs of the surrogate, newest first")
    workers: list[WorkerView] = Field(description="trainer workers that claimed or reported within the last minute")
