"""Wire models of queries, samples and reports of real steps."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from surrogym_shared.checks import require
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

QUERY_LEASE_SECONDS = 60.0  # default duration of a sampler's lease of a query

MAX_POLICY = 3 * 2**17  # largest number of characters of the policy of a trial

ActionSequence = Annotated[list[Vector], Field(min_length=1, max_length=MAX_ROLLOUT_QUERY)]


class ClaimQueries(Request):
    """Request of a sampler to lease pending queries."""

    sampler: Key = Field(description="name of the sampler, which people see with its queries and samples")
    max_queries: Annotated[int, Field(ge=0, le=MAX_CLAIM)] = Field(
        default=1, description="largest number of queries to lease; 0: none, because the sampler ends"
    )
    wait_seconds: Annotated[float, Field(ge=0, le=60)] = Field(
        default=0.0, description="seconds that the reply may wait for a query; 0: reply at once"
    )
    lease_seconds: Annotated[float, Field(gt=0, le=86_400)] = Field(
        default=QUERY_LEASE_SECONDS, description="seconds until the leases end, unless the sampler renews them"
    )


class LeasedQuery(Reply):
    """Base class of the queries that a sampler has claimed, with the fields that all kinds of queries have."""

    id: int = Field(description="id of the query, which its samples have as ``query_id``")
    number: int = Field(description="how many queries of the surrogate are older than this query")
    purpose: Purpose = Field(description="why the server requests the real steps")
    attempt: int = Field(description="number of this lease among the leases of the query: 1, 2, ...")
    lease_token: str = Field(
        description="token of the lease, to be sent with the samples, with a renewal, and with the report of a failure"
    )
    lease_seconds: float = Field(
        description="seconds from this reply until the lease ends, unless the sampler renews the lease"
    )


class StepQuery(LeasedQuery):
    """Query of one step: set the original environment to ``coordinates``, apply ``action``, report one sample."""

    kind: Literal["step"] = "step"
    coordinates: list[float] = Field(description="(C,) coordinates of the state to set")
    action: list[float] = Field(
        description="(F,) action to apply: continuous values, or the number of the choice for each discrete entry"
    )


class RolloutQuery(LeasedQuery):
    """Query of a rollout: reset the original environment, or return to a snapshot, apply ``actions`` in order, and
    report a sample of each step.

    There are fewer samples if the episode ends, or the environment fails, before the last action.
    """

    kind: Literal["rollout"] = "rollout"
    actions: list[list[float]] = Field(
        description="(T, F) actions of F entries to apply in T steps, one after the other"
    )
    snapshot: str | None = Field(default=None, description="name of the snapshot to begin at; null: begin at a reset")
    replan: bool = Field(
        default=False,
        description="whether to plan each action anew on the surrogate's latest model, from the measured state; "
        "``actions`` are then only expected, and to be applied where nothing can be planned",
    )
    policy: str | None = Field(
        default=None,
        description="file of the policy, in base64, that chooses each action from the measured state; ``actions`` are "
        "then only expected; null: apply ``actions``",
    )


Query = Annotated[StepQuery | RolloutQuery, Field(discriminator="kind")]


class ClaimedQueries(Reply):
    """Reply with the queries that a sampler has leased. It has none if no query became available in time."""

    queries: list[Query] = Field(description="leased queries")
    phase: Phase = Field(description="present phase of the design")
    paused: bool = Field(description="whether the design is paused; no sampler gets queries then")


class RenewLease(Request):
    """Request of a sampler to extend the lease of a query to ``lease_seconds`` from now."""

    lease_token: Key = Field(description="token of the lease")
    lease_seconds: Annotated[float, Field(gt=0, le=86_400)] = Field(
        default=QUERY_LEASE_SECONDS, description="seconds from now until the lease ends"
    )


class FailQuery(Request):
    """Request of a sampler to hand a query back without an answer. Another sampler may claim it then, unless the field
    ``refused`` says that the original environment refused it."""

    lease_token: Key = Field(description="token of the lease")
    error: Annotated[str, Field(min_length=1, max_length=4_000)] = Field(
        description="why the sampler could not answer the query, for people"
    )
    begun: bool = Field(
        default=True,
        description="whether real steps may have been taken; if so, the lease counts as an attempt, and the steps of "
        "the query count as unresolved",
    )
    refused: bool = Field(
        default=False,
        description="whether the original environment refused the query before a real step. The query is then not "
        "leased again and does not count towards the budget, and ``begun`` is ignored",
    )


class QueryView(Reply):
    """A query with its status and its leases, for people and for the dashboard."""

    id: int = Field(description="id of the query")
    purpose: Purpose = Field(description="why the server requests the real steps")
    status: QueryStatus = Field(
        description="pending, leased by a sampler, answered, set aside after its last attempt, or refused by the "
        "original environment"
    )
    round: int = Field(description="number of rounds of the design before the query was chosen")
    kind: QueryKind = Field(
        description="``step``: one step from a state; ``rollout``: an action sequence from a reset or a snapshot"
    )
    coordinates: list[float] | None = Field(description="(C,) coordinates to set for a step; null for a rollout")
    actions: list[list[float]] = Field(description="(T, F) actions to apply in T steps; T is 1 for a query of one step")
    snapshot: str | None = Field(
        default=None, description="name of the snapshot at which a rollout begins; null for a step, and for a reset"
    )
    replan: bool = Field(
        default=False, description="whether the sampler plans each action anew, so that ``actions`` are only expected"
    )
    policy: bool = Field(
        default=False, description="whether a policy chooses each action, so that ``actions`` are only expected"
    )
    attempts: int = Field(description="how often the query has been leased so far")
    sampler: str | None = Field(description="name of the sampler that claimed the query last; null if none has")
    error: str | None = Field(description="error of the last lease that ended without an answer; null if there is none")
    lease_seconds_left: float | None = Field(
        default=None,
        description="seconds until the lease of a sampler ends, by the server's clock; negative after its end; null if "
        "the query is not leased",
    )


class QueryList(Reply):
    """Reply with queries of a surrogate."""

    queries: list[QueryView] = Field(description="the listed or added queries, oldest first")


class AddQueries(Request):
    """Request to add queries that a person or a program chose.

    Give either ``coordinates`` with ``action``, for single steps, or ``rollouts``.
    """

    coordinates: Matrix | None = Field(
        default=None, description="(m, C) states to set, one for each of m queries of one step"
    )
    action: Matrix | None = Field(default=None, description="(m, F) action to apply in each of the m states")
    rollouts: Annotated[list[ActionSequence], Field(min_length=1, max_length=MAX_CLAIM)] | None = Field(
        default=None, description="action sequences, each (T, F), to apply after a reset"
    )
    policy: Annotated[str, Field(max_length=MAX_POLICY)] | None = Field(
        default=None,
        description="file of the policy, in base64, that chooses each action of the rollouts, whose actions are then "
        "only expected; null: apply the actions",
    )
    replan: bool = Field(
        default=False,
        description="whether the sampler plans each action of the rollouts anew on the latest model; the actions are "
        "then only expected",
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
        default=None, description="id of the query that the sample answers; null for a step without a query"
    )
    lease_token: Key | None = Field(
        default=None, description="token of the query's lease; null for a step without a query"
    )
    step: Annotated[int, Field(ge=0, lt=MAX_ROLLOUT_QUERY)] = Field(
        default=0,
        description="index of the step in its rollout, from 0; each step begins where the step before ended",
    )
    coordinates: Vector = Field(description="(C,) state before the step")
    action: Vector = Field(description="(F,) action that was applied")
    next_coordinates: Vector = Field(description="(C,) state after the step")
    reward: Measured = Field(description="reward of the step")
    terminated: bool = Field(description="whether the step ended the episode in a terminal state")
    truncated: bool = Field(
        default=False, description="whether the step ended the episode for another reason, such as a time limit"
    )
    observation: Vector | None = Field(
        default=None,
        description="(D,) the environment's own observation before the step, to be stored; null if it was not measured",
    )
    next_observation: Vector | None = Field(
        default=None, description="(D,) the environment's own observation after the step; null if it was not measured"
    )
    snapshot: Key | None = Field(
        default=None,
        description="name under which the sampler saved the state after the step (snapshot), where queries may begin; "
        "null if it saved none",
    )
    seconds: Annotated[Measured, Field(ge=0)] | None = Field(
        default=None,
        description="seconds since the end of the step before in the same rollout, by the sampler's clock; null for a "
        "first step, and if they were not measured",
    )


class AddSamples(Request):
    """Samples to store: answers to queries, real steps without a query, or recorded steps of a log."""

    sampler: Key = Field(description="name of the sampler, shown with the samples")
    samples: Annotated[list[NewSample], Field(min_length=1, max_length=4_096)] = Field(
        description="samples to store, all or none"
    )
    purpose: Literal["manual", "logged"] = Field(
        default="manual",
        description="purpose of the samples that answer no query. ``manual``: they count towards the budget. "
        "``logged``: they were recorded before, and don't count. A logged sample is identified by its numbers and "
        "by all earlier samples of its log, so sending a log again changes nothing",
    )
    after: Key | None = Field(
        default=None,
        description="for logged samples: ``digest`` from the reply to the previous part of the log; null: this is the "
        "first part. Any other text begins a log that is distinct from logs with the same numbers",
    )
    complete: bool = Field(
        default=True, description="whether the log is complete; false: more parts follow, and no fit becomes due yet"
    )
    idempotency_key: Key | None = Field(
        default=None,
        description="required if samples without a query are not logged: a repeat with the same key adds nothing",
    )


class AddedSamples(Reply):
    """Reply after the samples were stored durably."""

    sample_ids: list[int] = Field(description="id of each sample, in the order of the request")
    duplicates: int = Field(description="number of samples that were stored before")
    ledger: Ledger = Field(description="counts of all real steps so far, by purpose")
    digest: str | None = Field(
        default=None,
        description="hash of the log up to here, to be sent as ``after`` with the next part; null without a log",
    )
    restart: str | None = Field(
        default=None,
        description="null: the samples were stored. Otherwise nothing was stored, because a stored log begins in the "
        "same way and differs here: send the log again from its first part, with this text as ``after``",
    )


class SnapshotView(Reply):
    """A snapshot: a saved state of the original environment, to which a sampler can return."""

    name: str = Field(description="name that the sampler gave the snapshot")
    coordinates: list[float] = Field(description="(C,) coordinates of the saved state")


class SnapshotList(Reply):
    """Snapshots (saved states) of a surrogate's samplers."""

    snapshots: list[SnapshotView] = Field(description="all stored snapshots, oldest first")


class DropSnapshots(Request):
    """Request to remove snapshots to which no sampler can return any more."""

    snapshots: Annotated[list[Key], Field(min_length=1, max_length=4_096)] = Field(
        description="names of the snapshots to remove"
    )


class DroppedSnapshots(Reply):
    """Reply after snapshots were removed."""

    dropped: int = Field(description="number of removed snapshots; unknown names don't count")


class SampleView(Reply):
    """A stored sample: the result of one real step."""

    id: int = Field(description="id of the sample")
    purpose: SamplePurpose = Field(description="why the real step was taken")
    query_id: int | None = Field(description="id of the query that the sample answers; null without a query")
    sampler: str = Field(description="name of the sampler that sent the sample")
    attempt: int = Field(
        description="number of the query's lease under which the step was taken, from 1; 0 without a query"
    )
    late: bool = Field(description="whether the query's lease had ended when the sample came")
    trajectory: int | None = Field(
        description="number that all samples of one rollout share; null if the sample belongs to no rollout"
    )
    step: int = Field(description="index of the step in its rollout, from 0")
    requested_coordinates: list[float] | None = Field(
        description="(C,) state that the query requested; null without a query, and in a rollout"
    )
    coordinates: list[float] = Field(description="(C,) state before the step, as achieved")
    action: list[float] = Field(description="(F,) action, as applied")
    next_coordinates: list[float] = Field(description="(C,) state after the step")
    reward: float = Field(description="reward of the step")
    terminated: bool = Field(description="whether the step ended the episode in a terminal state")
    truncated: bool = Field(description="whether the step ended the episode for another reason")
    seconds: float | None = Field(
        default=None,
        description="seconds since the end of the step before in the same rollout; null if they were not measured",
    )
    created_at: float = Field(description="when the sample was stored, in seconds since 1970, by the server's clock")


class SamplePage(Reply):
    """One page of a surrogate's samples."""

    samples: list[SampleView] = Field(description="samples of this page, oldest first")
    next_after: int | None = Field(description="value of ``after`` for the next page; null on the last page")


class DirtFinding(Reply):
    """Dirt of a machine, such as a dead time, an encoder, friction that sticks or noise."""

    name: str = Field(description="kind of dirt")
    said: str = Field(description="what was found, as a sentence")


class DirtList(Reply):
    """Dirt of a machine that can only be reset."""

    findings: list[DirtFinding] = Field(description="what was found in the first real steps; empty for nothing")


class LimitsKept(Reply):
    """How well all real steps kept the limits of the specification."""

    said: list[str] = Field(description="a sentence for each limit, and one on the fallback; empty without limits")


class LimitCounts(Request):
    """How real episodes of a policy kept the limits of their specification. Each episode that left a limit, and each
    step in which the fallback acted, is counted."""

    violations: Annotated[int, Field(ge=0, le=1_000_000_000)] = Field(
        description="number of episodes that left a limit"
    )
    fallbacks: Annotated[int, Field(ge=0, le=1_000_000_000)] = Field(
        description="number of steps in which the fallback acted, because the state was within a margin"
    )
    fallback_episodes: Annotated[int, Field(ge=0, le=1_000_000_000)] = Field(
        description="number of episodes with such a step"
    )

    def require_fit(self, episodes: int, steps: int) -> None:
        """Check that the counts are possible in so many episodes and steps. Raises ``ValueError``."""
        require(
            self.violations <= episodes
            and self.fallback_episodes <= min(episodes, self.fallbacks, steps)
            and self.fallbacks <= steps,
            f"limits: expected counts that are possible in {episodes} episodes with {steps} steps, got "
            f"{self.violations} violations and {self.fallbacks} fallbacks in {self.fallback_episodes} episodes",
        )


class ReportSteps(Request):
    """Report of the number of real steps that an evaluation took. They don't count towards the budget."""

    purpose: Literal["evaluation"] = "evaluation"
    steps: Annotated[int, Field(ge=1, le=1_000_000_000)] = Field(description="number of real steps that were taken")
    episodes: Annotated[int, Field(ge=0, le=1_000_000_000)] = Field(
        default=0, description="number of episodes in which the steps were taken"
    )
    note: Annotated[str, Field(max_length=1_000)] = Field(
        default="", description="remark for people, stored with the report"
    )
    limits: LimitCounts | None = Field(
        default=None, description="how the episodes kept the limits of the specification; null without limits"
    )
    idempotency_key: Key = Field(description="a repeat with the same key adds nothing")

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if self.limits is not None:
            self.limits.require_fit(self.episodes, self.steps)
        return self


class Trial(Request):
    """An episode of the original environment, from a reset, in which the sampler lets a policy choose each action."""

    policy: Annotated[str, Field(max_length=MAX_POLICY)] = Field(
        description="file of the policy, in base64, as ``Network.save`` writes it"
    )
    actions: ActionSequence = Field(
        description="(T, F) actions that the model expects of the policy; T is the largest number of steps"
    )


class Improve(Request):
    """Request for further queries, which the design's acquisition chooses, or for a trial of a policy.

    The budget must have enough real steps left. With a token of role ``admin``, the budget is raised as needed.
    """

    queries: Annotated[int, Field(ge=1, le=10_000)] | None = Field(
        default=None,
        description="number of real steps of the further queries; each step of a rollout counts; null for a trial",
    )
    checkpoint: Key | None = Field(
        default=None,
        description="name of the submitted occupancy (states that policies visited) near which to choose the queries; "
        "null: the latest one, if there is any",
    )
    trial: Trial | None = Field(
        default=None,
        description="trial of a policy, instead of ``queries`` that the acquisition chooses; null: no trial",
    )
    idempotency_key: Key | None = Field(default=None, description="a repeat with the same key adds nothing")

    @model_validator(mode="after")
    def _queries_or_a_trial(self) -> Self:
        if (self.queries is None) == (self.trial is None):
            raise ValueError("expected either queries or trial")
        return self
