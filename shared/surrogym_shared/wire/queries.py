"""Wire models of queries, samples and the ledger."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from surrogym_shared.spec import MAX_ROLLOUT_QUERY
from surrogym_shared.wire.base import (
    MAX_BATCH,
    MAX_CLAIM,
    Key,
    Matrix,
    Measured,
    Phase,
    Purpose,
    QueryKind,
    QueryStatus,
    Reply,
    Request,
    SamplePurpose,
    Vector,
)
from surrogym_shared.wire.surrogates import Ledger

ActionSequence = Annotated[list[Vector], Field(min_length=1, max_length=MAX_ROLLOUT_QUERY)]


class ClaimQueries(Request):
    sampler: Key = Field(description="name of the worker, shown in the ledger")
    max_queries: Annotated[int, Field(ge=1, le=MAX_CLAIM)] = 1
    wait_seconds: Annotated[float, Field(ge=0, le=60)] = 0.0
    lease_seconds: Annotated[float, Field(gt=0, le=86_400)] = 60.0


class LeasedQuery(Reply):
    """Fields of every query that a sampler has claimed."""

    id: int
    number: int = Field(description="how many queries of the surrogate came before it")
    purpose: Purpose
    attempt: int = Field(description="1 for the first lease of this query")
    lease_token: str
    lease_seconds: float


class StepQuery(LeasedQuery):
    """Query of one step: set the original environment to ``coordinates``, apply ``action``, report one sample."""

    kind: Literal["step"] = "step"
    coordinates: list[float]
    action: list[float] = Field(description="(F,) continuous value, or the number of each discrete action")


class RolloutQuery(LeasedQuery):
    """Query of a rollout: reset the original environment, apply ``actions`` in order, and report a sample of each step.

    There are fewer samples if the episode ends, or the environment fails, before the last action.
    """

    kind: Literal["rollout"] = "rollout"
    actions: list[list[float]] = Field(description="(T, F)")


Query = Annotated[StepQuery | RolloutQuery, Field(discriminator="kind")]


class ClaimedQueries(Reply):
    queries: list[Query]
    phase: Phase
    paused: bool


class RenewLease(Request):
    lease_token: Key
    lease_seconds: Annotated[float, Field(gt=0, le=86_400)] = 60.0


class FailQuery(Request):
    lease_token: Key
    error: Annotated[str, Field(min_length=1, max_length=4_000)]
    begun: bool = Field(default=True, description="whether a real step may have been taken; false: it counts nowhere")


class QueryView(Reply):
    id: int
    purpose: Purpose
    status: QueryStatus
    round: int
    kind: QueryKind
    coordinates: list[float] | None = Field(description="(C,) of a step; null for a rollout")
    actions: list[list[float]] = Field(description="(T, F), with T = 1 for a step")
    attempts: int
    sampler: str | None
    error: str | None
    lease_seconds_left: float | None = Field(
        default=None, description="of the lease that a sampler holds, by the server's clock; below 0 it has run out"
    )


class QueryList(Reply):
    queries: list[QueryView]


class AddQueries(Request):
    """Queries by hand: steps from ``coordinates`` with ``action``; or ``rollouts``, action sequences from a reset."""

    coordinates: Matrix | None = None
    action: Matrix | None = None
    rollouts: Annotated[list[ActionSequence], Field(min_length=1, max_length=MAX_CLAIM)] | None = None
    idempotency_key: Key | None = None


class AuditModel(AddQueries):
    """Request for the real steps of an audit, which compare the model with reality where a policy goes.

    They don't count towards the design's budget. All audits of a surrogate together have at most as many steps as this
    budget.
    """


class WithdrawQueries(Request):
    query_ids: Annotated[list[Annotated[int, Field(ge=1)]], Field(min_length=1, max_length=MAX_BATCH)]


class WithdrawnQueries(Reply):
    withdrawn: int = Field(description="how many were removed: pending ones that no sampler had begun")


class NewSample(Request):
    """One real step. ``coordinates`` and ``action`` are the achieved values, not the requested ones."""

    query_id: Annotated[int, Field(ge=1)] | None = None
    lease_token: Key | None = None
    step: Annotated[int, Field(ge=0, lt=MAX_ROLLOUT_QUERY)] = Field(
        default=0, description="place in the rollout; each begins where the one before ended"
    )
    coordinates: Vector
    action: Vector
    next_coordinates: Vector
    reward: Measured
    terminated: bool
    truncated: bool = False
    observation: Vector | None = None
    next_observation: Vector | None = None


class AddSamples(Request):
    sampler: Key
    samples: Annotated[list[NewSample], Field(min_length=1, max_length=4_096)]
    purpose: Literal["manual", "logged"] = Field(
        default="manual",
        description="of samples without a query. ``logged``: they were recorded before and cost no budget; one that is "
        "there already, the same in every number, is a duplicate",
    )
    complete: bool = Field(
        default=True, description="false: more of the same log follows, so no fit becomes due for this part"
    )
    idempotency_key: Key | None = Field(
        default=None,
        description="needed for samples without a query, but not for logged ones: a repeat with it is harmless",
    )


class AddedSamples(Reply):
    """Reply after the samples are committed."""

    sample_ids: list[int]
    duplicates: int = Field(description="how many of them were already there")
    ledger: Ledger


class SampleView(Reply):
    id: int
    purpose: SamplePurpose
    query_id: int | None
    sampler: str
    attempt: int
    late: bool = Field(description="answered under a lease that had expired")
    trajectory: int | None = Field(description="equal for the samples of one rollout; null for others")
    step: int = Field(description="place in the rollout")
    requested_coordinates: list[float] | None
    coordinates: list[float]
    action: list[float]
    next_coordinates: list[float]
    reward: float
    terminated: bool
    truncated: bool
    created_at: float


class SamplePage(Reply):
    samples: list[SampleView]
    next_after: int | None = Field(description="give it as ``after`` for the next page; null at the end")


class ReportSteps(Request):
    """Real steps taken outside the design, in an evaluation."""

    purpose: Literal["evaluation"] = "evaluation"
    steps: Annotated[int, Field(ge=1, le=1_000_000_000)]
    episodes: Annotated[int, Field(ge=0, le=1_000_000_000)] = 0
    note: Annotated[str, Field(max_length=1_000)] = ""
    idempotency_key: Key


class Improve(Request):
    """Add queries to the design, chosen by the acquisition.

    The budget must have enough steps left; with a token of role admin it is raised as needed.
    """

    queries: Annotated[int, Field(ge=1, le=10_000, description="real steps: a rollout's count one by one")]
    checkpoint: Key | None = Field(default=None, description="weigh by the occupancy submitted under this name")
    idempotency_key: Key | None = None
