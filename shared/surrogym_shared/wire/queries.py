"""Wire models of queries, samples and reports of real steps."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from surrogym_shared.spec import MAX_ROLLOUT_QUERY
from surrogym_shared.wire.base import (
    LEASE_SECONDS,
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
    """Request of a sampler for queries, which it holds under leases."""

    sampler: Key = Field(description="name of the sampler, shown in the ledger")
    max_queries: Annotated[int, Field(ge=1, le=MAX_CLAIM)] = Field(default=1, description="most queries to lease")
    wait_seconds: Annotated[float, Field(ge=0, le=60)] = Field(
        default=0.0, description="seconds that the reply may wait for a query; 0: reply at once"
    )
    lease_seconds: Annotated[float, Field(gt=0, le=86_400)] = Field(
        default=LEASE_SECONDS, description="seconds until the leases end, unless they are renewed"
    )


class LeasedQuery(Reply):
    """Base class of the queries that a sampler has claimed, with the fields that all kinds of queries have."""

    id: int = Field(description="id of the query; its samples name it as ``query_id``")
    number: int = Field(description="number of the surrogate's earlier queries")
    purpose: Purpose = Field(description="why the real step is wanted")
    attempt: int = Field(description="1 for the first lease of this query")
    lease_token: str = Field(
        description="token of the lease; it is sent with the samples, and to renew or return the query"
    )
    lease_seconds: float = Field(description="seconds from this reply until the lease ends, unless it is renewed")


class StepQuery(LeasedQuery):
    """Query of one step: set the original environment to ``coordinates``, apply ``action``, report one sample."""

    kind: Literal["step"] = "step"
    coordinates: list[float] = Field(description="(C,) state to set")
    action: list[float] = Field(
        description="(F,) action to apply: continuous values, or the number of each discrete action"
    )


class RolloutQuery(LeasedQuery):
    """Query of a rollout: reset the original environment, or return to a snapshot, apply ``actions`` in order, and
    report a sample of each step.

    There are fewer samples if the episode ends, or the environment fails, before the last action.
    """

    kind: Literal["rollout"] = "rollout"
    actions: list[list[float]] = Field(description="(T, F) actions to apply from there, in this order")
    snapshot: str | None = Field(default=None, description="name of the snapshot to begin at; null: begin at a reset")


Query = Annotated[StepQuery | RolloutQuery, Field(discriminator="kind")]


class ClaimedQueries(Reply):
    """Reply with the queries that a sampler has leased. It has none if no query became available in time."""

    queries: list[Query] = Field(description="leased queries")
    phase: Phase = Field(description="present phase of the design")
    paused: bool = Field(description="whether the design is paused; then nobody gets queries")


class RenewLease(Request):
    """Heartbeat of a sampler. It renews the lease of a query for ``lease_seconds``."""

    lease_token: Key = Field(description="token of the lease")
    lease_seconds: Annotated[float, Field(gt=0, le=86_400)] = Field(
        default=LEASE_SECONDS, description="seconds from now until the lease ends"
    )


class FailQuery(Request):
    """Request of a sampler to hand a query back without an answer. Another sampler may claim it, unless ``refused``."""

    lease_token: Key = Field(description="token of the lease")
    error: Annotated[str, Field(min_length=1, max_length=4_000)] = Field(
        description="why there is no answer, shown to people"
    )
    begun: bool = Field(
        default=True,
        description="whether a real step may have been taken; if so, it counts as an attempt and as unresolved",
    )
    refused: bool = Field(
        default=False,
        description="whether the original environment refused the query before a real step; then nobody claims it "
        "again, it counts neither as an attempt nor towards the budget, and ``begun`` is ignored",
    )


class QueryView(Reply):
    """A query as people see it."""

    id: int = Field(description="id of the query")
    purpose: Purpose = Field(description="why the real step is wanted")
    status: QueryStatus = Field(
        description="pending, leased by a sampler, answered, set aside after its last attempt, or refused by the "
        "original environment"
    )
    round: int = Field(description="number of fits before the query was made")
    kind: QueryKind = Field(description="one step, or a rollout from a reset or a snapshot")
    coordinates: list[float] | None = Field(description="(C,) state to set for a step; null for a rollout")
    actions: list[list[float]] = Field(description="(T, F) actions; T = 1 for a step")
    snapshot: str | None = Field(
        default=None, description="name of the snapshot at which a rollout begins; null for a step, and for a reset"
    )
    attempts: int = Field(description="number of leases so far")
    sampler: str | None = Field(description="name of the last sampler that claimed it")
    error: str | None = Field(description="error of the last attempt that failed")
    lease_seconds_left: float | None = Field(
        default=None,
        description="seconds left of the lease that a sampler holds, by the server's clock; negative if it has "
        "ended; null without a lease",
    )


class QueryList(Reply):
    """Queries of a surrogate."""

    queries: list[QueryView] = Field(description="the queries")


class AddQueries(Request):
    """Request to add queries that a person or a program chose.

    Give either ``coordinates`` with ``action``, for single steps, or ``rollouts``.
    """

    coordinates: Matrix | None = Field(default=None, description="(m, C) states to set")
    action: Matrix | None = Field(default=None, description="(m, F) the action to apply in each of them")
    rollouts: Annotated[list[ActionSequence], Field(min_length=1, max_length=MAX_CLAIM)] | None = Field(
        default=None, description="action sequences, each (T, F), to apply after a reset"
    )
    idempotency_key: Key | None = Field(default=None, description="a repeat with the same key adds nothing")


class AuditModel(AddQueries):
    """Request for the real steps of an audit, which compare the model with the original environment at states that a
    policy visits.

    They don't count towards the design's budget. All audits of a surrogate together have at most as many steps as
    this budget, or 128 if the budget is smaller.
    """


class WithdrawQueries(Request):
    """Request to remove pending queries that no sampler has begun."""

    query_ids: Annotated[list[Annotated[int, Field(ge=1)]], Field(min_length=1, max_length=MAX_BATCH)] = Field(
        description="ids of the queries"
    )


class WithdrawnQueries(Reply):
    """Reply to a request to remove queries."""

    withdrawn: int = Field(description="number of queries that were removed; those that a sampler had begun stay")


class NewSample(Request):
    """Result of one real step. ``coordinates`` and ``action`` are the achieved values, not the requested ones."""

    query_id: Annotated[int, Field(ge=1)] | None = Field(
        default=None, description="id of the query that this sample answers; null for a step without a query"
    )
    lease_token: Key | None = Field(
        default=None, description="token of the query's lease; null for a step without a query"
    )
    step: Annotated[int, Field(ge=0, lt=MAX_ROLLOUT_QUERY)] = Field(
        default=0, description="place in the rollout, from 0; each step begins where the one before ended"
    )
    coordinates: Vector = Field(description="(C,) state before the step")
    action: Vector = Field(description="(F,) action")
    next_coordinates: Vector = Field(description="(C,) state after the step")
    reward: Measured = Field(description="reward of the step")
    terminated: bool = Field(description="whether the step ended the episode in a terminal state")
    truncated: bool = Field(
        default=False, description="whether the step ended the episode for another reason, such as a time limit"
    )
    observation: Vector | None = Field(
        default=None, description="(D,) the environment's own observation before the step; stored with the sample"
    )
    next_observation: Vector | None = Field(default=None, description="(D,) the same after the step")
    snapshot: Key | None = Field(
        default=None,
        description="name under which the sampler saved the state after the step; queries may begin there",
    )


class AddSamples(Request):
    """Samples to store: answers to queries, real steps without a query, or recorded steps of a log."""

    sampler: Key = Field(description="name of the sampler, shown with the samples")
    samples: Annotated[list[NewSample], Field(min_length=1, max_length=4_096)] = Field(description="the samples")
    purpose: Literal["manual", "logged"] = Field(
        default="manual",
        description="purpose of the samples that answer no query. ``manual``: they count towards the budget. "
        "``logged``: they were recorded before and don't. Each is identified by its numbers and by all samples "
        "of its log before it, so the same log again changes nothing",
    )
    after: Key | None = Field(
        default=None,
        description="for logged samples: ``digest`` of the reply to the part of the log before; null: the log begins "
        "here. Another text begins a log that differs from logs with the same numbers",
    )
    complete: bool = Field(
        default=True, description="false: more of the same log follows, so no fit becomes due for this part"
    )
    idempotency_key: Key | None = Field(
        default=None,
        description="needed for samples without a query, but not for logged ones: a repeat with it is harmless",
    )


class AddedSamples(Reply):
    """Reply after the samples were stored durably."""

    sample_ids: list[int] = Field(description="id of each sample, in the order of the request")
    duplicates: int = Field(description="number of samples that were stored before")
    ledger: Ledger = Field(description="real steps so far")
    digest: str | None = Field(
        default=None, description="identifies the log up to here; give it as ``after`` with the next part"
    )
    restart: str | None = Field(
        default=None,
        description="not null: nothing was stored, because the log differs here from a stored one that begins in the "
        "same way; send it again from its beginning, with this as ``after``",
    )


class SnapshotView(Reply):
    """A snapshot that a sampler holds."""

    name: str = Field(description="name that the sampler gave it")
    coordinates: list[float] = Field(description="(C,) state to which it returns")


class SnapshotList(Reply):
    """Snapshots that samplers hold."""

    snapshots: list[SnapshotView] = Field(description="every snapshot that is known, oldest first")


class DropSnapshots(Request):
    """Request to forget snapshots that no sampler holds any more."""

    snapshots: Annotated[list[Key], Field(min_length=1, max_length=4_096)] = Field(
        description="name of each snapshot that is gone"
    )


class DroppedSnapshots(Reply):
    """Reply after the snapshots were forgotten."""

    dropped: int = Field(description="number of them that were known")


class SampleView(Reply):
    """A stored sample: the result of one real step."""

    id: int = Field(description="id of the sample")
    purpose: SamplePurpose = Field(description="why the real step was taken")
    query_id: int | None = Field(description="id of the query that it answers; null without one")
    sampler: str = Field(description="name of the sampler that sent it")
    attempt: int = Field(description="number of the query's lease under which it was taken; 0 without a query")
    late: bool = Field(description="whether the lease had ended when the sample came")
    trajectory: int | None = Field(description="number shared by the samples of one rollout; null for others")
    step: int = Field(description="place in the rollout, from 0")
    requested_coordinates: list[float] | None = Field(
        description="(C,) state that the query wanted; null without a query, and in a rollout"
    )
    coordinates: list[float] = Field(description="(C,) achieved state before the step")
    action: list[float] = Field(description="(F,) achieved action")
    next_coordinates: list[float] = Field(description="(C,) state after the step")
    reward: float = Field(description="reward of the step")
    terminated: bool = Field(description="whether the step ended the episode in a terminal state")
    truncated: bool = Field(description="whether the step ended the episode for another reason")
    created_at: float = Field(description="when it was stored, in seconds since 1970, by the server's clock")


class SamplePage(Reply):
    """One page of a surrogate's samples."""

    samples: list[SampleView] = Field(description="samples, oldest first")
    next_after: int | None = Field(description="value of ``after`` for the next page; null on the last page")


class ReportSteps(Request):
    """Report of the number of real steps that an evaluation took. They don't count towards the budget."""

    purpose: Literal["evaluation"] = "evaluation"
    steps: Annotated[int, Field(ge=1, le=1_000_000_000)] = Field(description="number of real steps")
    episodes: Annotated[int, Field(ge=0, le=1_000_000_000)] = Field(
        default=0, description="number of episodes that they belong to"
    )
    note: Annotated[str, Field(max_length=1_000)] = Field(
        default="", description="remark for people, stored with the report"
    )
    idempotency_key: Key = Field(description="a repeat with the same key adds nothing")


class Improve(Request):
    """Request for further queries, which the design's acquisition chooses.

    The budget must have enough real steps left. With a token of role ``admin``, it is raised as needed.
    """

    queries: Annotated[int, Field(ge=1, le=10_000, description="number of real steps; each step of a rollout counts")]
    checkpoint: Key | None = Field(
        default=None,
        description="name of submitted occupancy that weighs the queries; null: the latest, if there is any",
    )
    idempotency_key: Key | None = Field(default=None, description="a repeat with the same key adds nothing")
