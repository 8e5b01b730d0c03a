"""Wire models of jobs: what a trainer worker is asked to do, how far it is, and how it ended."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from surrogym_shared.wire.base import VISIBLE, Key, Measured, Reply, Request

MAX_JOB_EPISODES = 1_000  # real episodes of an evaluation
MAX_JOB_STEPS = 10_000_000  # virtual steps of a training
MAX_JOB_POINTS = 200  # of a curve

JobAlgorithm = Literal["ppo", "fastppo", "a2c", "sac", "td3", "ddpg", "dqn", "cmaes", "gradient"]
JobPreset = Literal["default", "quick"]
JobStatus = Literal["queued", "running", "done", "failed", "cancelled"]
JobEnd = Literal["done", "failed", "cancelled"]
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
    algorithm: JobAlgorithm | None = Field(default=None, description="null: as ``surrogym train`` chooses")
    steps: Annotated[int, Field(ge=1, le=MAX_JOB_STEPS)] | None = Field(
        default=None, description="virtual steps at most; null: as the algorithm suggests"
    )
    preset: JobPreset = Field(
        default="default",
        description="``quick``: a quarter of the steps that the algorithm suggests, and never prolonged; to see "
        "whether it learns",
    )
    seed: Seed = 0
    audit: bool = Field(
        default=True,
        description="audit the policy by a few real steps, if a sampler is connected; if the audit fails, further "
        "steps of the budget are taken",
    )

    @model_validator(mode="after")
    def _one_length(self) -> TrainTask:
        if self.preset == "quick" and self.steps is not None:
            raise ValueError("expected steps or preset quick, got both")
        return self


class EvaluateTask(Request):
    """Real episodes with a stored policy, in the environment of the worker, as by ``surrogym evaluate``."""

    kind: Literal["evaluate"]
    policy: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,31}$")] = Field(
        default="latest", description="version, alias, or latest"
    )
    episodes: Annotated[int, Field(ge=1, le=MAX_JOB_EPISODES)] = 100
    first_seed: Seed = 10_000
    wide: bool = Field(default=False, description="start anywhere in the sampling range")
    compare: Literal["zero", "random"] | None = Field(
        default=None, description="also run the same starts without the policy, with these actions"
    )

    @model_validator(mode="after")
    def _within_limit(self) -> EvaluateTask:
        if self.real_episodes > MAX_JOB_EPISODES:
            raise ValueError(
                f"expected at most {MAX_JOB_EPISODES} episodes with the comparison's, got {self.real_episodes}"
            )
        return self

    @property
    def real_episodes(self) -> int:
        """Of the policy and of the comparison together."""
        return self.episodes * (1 if self.compare is None else 2)


Task = Annotated[TrainTask | EvaluateTask, Field(discriminator="kind")]


class AddJob(Request):
    task: Task
    idempotency_key: Key | None = None


class ClaimJob(Request):
    worker: Key = Field(description="name of the worker, which people see")
    most_episodes: Annotated[int, Field(ge=0, le=MAX_JOB_EPISODES)] = Field(
        default=0, description="most real episodes of an evaluation that this worker takes; 0: it only trains"
    )
    wait_seconds: Annotated[float, Field(ge=0, le=60)] = 0.0
    lease_seconds: LeaseSeconds = 60.0


class LeasedJob(Reply):
    id: int
    attempt: int = Field(description="1 for the first lease of this job")
    lease_token: str
    lease_seconds: float
    task: Task


class ClaimedJob(Reply):
    job: LeasedJob | None


class JobPoint(Request):
    """One point of a training's curve."""

    steps: Count
    imagined_return: Measured | None = None


class JobState(Request):
    """How far a job is. ``curve`` holds all points so far; it replaces the earlier one."""

    stage: JobStage
    share: Share = Field(default=0.0, description="of this stage that is done")
    steps: Count | None = Field(default=None, description="virtual steps of a training so far")
    total_steps: Count | None = None
    imagined_return: Measured | None = Field(default=None, description="of the policy at its last check")
    curve: list[JobPoint] = Field(default=[], max_length=MAX_JOB_POINTS)


class ReportJob(Request):
    """Heartbeat of a worker: its lease ends ``lease_seconds`` from now."""

    lease_token: Key
    lease_seconds: LeaseSeconds = 60.0
    state: JobState | None = None


class ReportedJob(Reply):
    cancel: bool = Field(description="the worker is to stop, and to keep the best policy so far")


class FinishJob(Request):
    lease_token: Key
    status: JobEnd
    error: Said | None = None
    version: Version | None = Field(default=None, description="of the policy that was stored or evaluated")
    evaluation: Number | None = Field(default=None, description="number of the policy's evaluation")


class JobView(Reply):
    id: int
    task: Task
    status: JobStatus
    cancelling: bool = Field(description="it runs, and its worker is asked to stop")
    created_at: float
    begun_at: float | None
    finished_at: float | None
    worker: str | None
    attempts: int
    stage: JobStage | None = None
    share: float = 0.0
    steps: int | None = None
    total_steps: int | None = None
    imagined_return: float | None = None
    error: str | None
    version: int | None
    evaluation: int | None


class JobDetail(JobView):
    curve: list[JobPoint]


class WorkerView(Reply):
    name: str
    most_episodes: int = Field(description="most real episodes of an evaluation that it takes; 0: it only trains")


class JobList(Reply):
    jobs: list[JobView] = Field(description="newest first")
    workers: list[WorkerView] = Field(description="trainer workers that asked or reported within a minute")
