"""Queries, samples and the ledger."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from surrogym_shared.wire.base import (
    MAX_CLAIM,
    Key,
    Matrix,
    Measured,
    Phase,
    Purpose,
    QueryStatus,
    Reply,
    Request,
    Vector,
)
from surrogym_shared.wire.surrogates import Ledger


class ClaimQueries(Request):
    sampler: Key = Field(description="name of the worker, shown in the ledger")
    max_queries: Annotated[int, Field(ge=1, le=MAX_CLAIM)] = 1
    wait_seconds: Annotated[float, Field(ge=0, le=60)] = 0.0
    lease_seconds: Annotated[float, Field(gt=0, le=86_400)] = 60.0


class Query(Reply):
    """One query to answer: set the original environment to ``coordinates``, apply ``action``, report one sample."""

    id: int
    kind: Literal["step"] = "step"
    purpose: Purpose
    coordinates: list[float]
    action: list[float] = Field(description="(F,) continuous value, or the number of each discrete action")
    attempt: int = Field(description="1 for the first lease of this query")
    lease_token: str
    lease_seconds: float


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


class QueryView(Reply):
    id: int
    purpose: Purpose
    status: QueryStatus
    round: int
    coordinates: list[float]
    action: list[float]
    attempts: int
    sampler: str | None
    error: str | None


class QueryList(Reply):
    queries: list[QueryView]


class AskQueries(Request):
    """Queries by hand."""

    coordinates: Matrix
    action: Matrix
    idempotency_key: Key | None = None


class NewSample(Request):
    """One real step. ``coordinates`` and ``action`` are what was achieved, not what was asked for."""

    query_id: Annotated[int, Field(ge=1)] | None = None
    lease_token: Key | None = None
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
    idempotency_key: Key | None = Field(
        default=None, description="needed for samples without a query: a repeat with the same key is harmless"
    )


class AddedSamples(Reply):
    """Sent after the commit."""

    sample_ids: list[int]
    duplicates: int = Field(description="how many of them were already there")
    ledger: Ledger


class SampleView(Reply):
    id: int
    purpose: Purpose
    query_id: int | None
    sampler: str
    attempt: int
    late: bool = Field(description="answered under a lease that had expired")
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
    """Real steps taken outside the design: evaluation."""

    purpose: Literal["evaluation"] = "evaluation"
    steps: Annotated[int, Field(ge=1, le=1_000_000_000)]
    episodes: Annotated[int, Field(ge=0, le=1_000_000_000)] = 0
    note: Annotated[str, Field(max_length=1_000)] = ""
    idempotency_key: Key


class Improve(Request):
    """Ask the design for more queries, chosen by the acquisition; budget is raised to fit them."""

    queries: Annotated[int, Field(ge=1, le=10_000)]
    checkpoint: Key | None = Field(default=None, description="weigh by the occupancy submitted under this name")
    idempotency_key: Key | None = None
