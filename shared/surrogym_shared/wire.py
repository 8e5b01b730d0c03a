"""Request and reply models of every route (JSON form). Unknown fields are refused; numbers must be finite.

Shapes: N lanes, D observation entries, C coordinates, F action entries, O model outputs (moving coordinates, reward).
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from surrogym_shared.spec import MAX_DIMENSIONS, NAME_PATTERN, EnvironmentSpec

PROTOCOL = 1
MAX_LANES = 65_536
MAX_PARTICLES = 1_000_000
MAX_CLAIM = 256
MAX_BATCH = 65_536
MAX_ROLLOUT = 100_000
MAX_MEASURED = 1e30  # beyond it variances overflow, and one such sample would leave no model to serve

Phase = Literal["collecting", "fitting", "sampling", "ready", "over_budget", "failed"]
Purpose = Literal["initial", "adaptive", "manual"]
QueryStatus = Literal["pending", "leased", "answered", "set_aside"]
Variant = Literal["deterministic", "probabilistic"]
AutoresetMode = Literal["next_step", "same_step", "disabled"]
Role = Literal["read", "train", "sample", "admin"]

SurrogateName = Annotated[str, Field(pattern=NAME_PATTERN)]
Key = Annotated[str, Field(min_length=1, max_length=128)]
Seed = Annotated[int, Field(ge=0, lt=2**63)]
Seq = Annotated[int, Field(ge=1)]
Measured = Annotated[float, Field(ge=-MAX_MEASURED, le=MAX_MEASURED, allow_inf_nan=False)]
Vector = Annotated[list[Measured], Field(min_length=1, max_length=MAX_DIMENSIONS)]
Matrix = Annotated[list[Vector], Field(min_length=1, max_length=MAX_BATCH)]


class Request(BaseModel):
    """Base of what a client sends: unknown fields are refused, booleans and strings are not numbers."""

    model_config = ConfigDict(extra="forbid", strict=True)


class Reply(BaseModel):
    """Base of what the server sends."""

    model_config = ConfigDict(extra="forbid")


# Surrogates


class CreateSurrogate(Request):
    model_config = ConfigDict(extra="forbid", strict=False)  # the specification brings its own strictness

    name: SurrogateName
    spec: EnvironmentSpec


class PatchSurrogate(Request):
    """What may change while the design runs; None leaves a field as it is."""

    paused: bool | None = None
    budget: Annotated[int, Field(ge=2, le=100_000)] | None = None
    target: Annotated[float, Field(gt=0.5, lt=1)] | None = None


class OutputFidelity(Reply):
    """How good the model of one output is; ``unit`` is the output's own."""

    name: str
    structure: str = Field(description="Chosen inputs and kernel, in words.")
    confidence_index: float = Field(description="mean Phi(tolerance / deviation) over the Monte Carlo set (eq. 8, 9)")
    confidence_index_paper: float = Field(description="mean Phi(1 / deviation): the paper's, in raw units")
    tolerance: float
    coverage: float = Field(description="share of the Monte Carlo set whose deviation is below the tolerance")
    leave_one_out_error: float = Field(description="root mean square, in the output's unit")


class Fidelity(Reply):
    confidence_index: float = Field(description="smallest over outputs, with tolerances")
    confidence_index_paper: float = Field(description="smallest over outputs, as printed in the paper")
    target: float
    samples: int
    outputs: list[OutputFidelity]


class Ledger(Reply):
    """Acknowledged real steps by purpose. ``total`` is what the design cost: initial + adaptive + manual; evaluation is
    apart, and ``unresolved`` counts leases that began and were never answered, so the true number of real steps lies
    between total and total + unresolved."""

    initial: int = 0
    adaptive: int = 0
    manual: int = 0
    total: int = 0
    evaluation: int = 0
    unresolved: int = 0


class QueryCounts(Reply):
    pending: int = 0
    leased: int = 0
    answered: int = 0
    set_aside: int = 0


class SurrogateSummary(Reply):
    name: str
    environment: str
    phase: Phase
    paused: bool
    round: int = Field(description="fits so far")
    samples: int
    model_version: int | None
    confidence_index: float | None
    created_at: float = Field(description="seconds since 1970, the server's clock")


class SurrogateView(SurrogateSummary):
    spec: EnvironmentSpec
    budget: int
    target: float
    outputs: list[str]
    fidelity: Fidelity | None
    ledger: Ledger
    queries: QueryCounts
    error: str | None = Field(default=None, description="why the phase is failed, or the last query was set aside")


class SurrogateList(Reply):
    surrogates: list[SurrogateSummary]


# Queries and samples


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


# Models


class Points(Request):
    coordinates: Matrix
    action: Matrix
    model: Annotated[int, Field(ge=1)] | None = Field(default=None, description="version; None is the latest")


class Uncertainty(Reply):
    """Per point and output: posterior mean of the output, latent deviation, U_m (eq. 10), P_i (eq. 11), U (eq. 12)."""

    model_version: int
    outputs: list[str]
    mean: list[list[float]]
    deviation: list[list[float]]
    model_uncertainty: list[list[float]]
    input_probability: list[list[float]]
    log_uncertainty_index: list[list[float]]
    uncertainty_index: list[list[float]]


class Prediction(Reply):
    model_version: int
    next_coordinates: list[list[float]]
    next_observation: list[list[float]]
    reward: list[float] = Field(description="posterior mean, without the penalty")
    reward_deviation: list[float]
    terminated: list[bool]


class ModelView(Reply):
    version: int
    created_at: float
    samples: int
    data_hash: str
    fidelity: Fidelity
    fit_seconds: float
    description: dict[str, Any] = Field(description="structure and hyperparameters of every output")


class ModelList(Reply):
    models: list[ModelView]


# Sessions


class OpenSession(Request):
    """One trainer's virtual environment. None takes the preset's value."""

    num_envs: Annotated[int, Field(ge=1, le=MAX_LANES)] = 1
    variant: Variant = "deterministic"
    seed: Seed | None = Field(default=None, description="None draws one; the reply says which")
    autoreset_mode: AutoresetMode = "next_step"
    model: Literal["latest"] | Annotated[int, Field(ge=1)] = "latest"
    time_limit: Annotated[int, Field(ge=1, le=10_000_000)] | None = Field(default=None, description="None: the spec's")
    penalty: Annotated[float, Field(ge=0, le=100)] | None = Field(default=None, description="k of eq. 14")
    start_box: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.0, description="share of episodes that start anywhere in the sampling range"
    )
    particles: Annotated[int, Field(ge=1, le=MAX_PARTICLES)] = 1_000
    propagation: Literal["mean", "sample"] = "sample"
    weighting: Literal["inverse_variance", "uniform"] = "inverse_variance"
    spread: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.01, description="initial deviation of particles, as a share of each coordinate's sampling range"
    )
    occupancy: bool = Field(default=False, description="collect visited coordinates, to be submitted at checkpoints")
    idempotency_key: Key | None = None


class BoxSpace(Reply):
    kind: Literal["box"] = "box"
    low: list[float | None] = Field(description="null is unbounded")
    high: list[float | None]
    dtype: Literal["float32"] = "float32"


class DiscreteSpace(Reply):
    kind: Literal["discrete"] = "discrete"
    n: int


class MultiDiscreteSpace(Reply):
    kind: Literal["multi_discrete"] = "multi_discrete"
    nvec: list[int]


ActionSpace = Annotated[BoxSpace | DiscreteSpace | MultiDiscreteSpace, Field(discriminator="kind")]


class SessionView(Reply):
    protocol: int = PROTOCOL
    id: str
    surrogate: str
    num_envs: int
    variant: Variant
    seed: int
    autoreset_mode: AutoresetMode
    model: Literal["latest"] | int
    model_version: list[int] = Field(description="(N,) the version each lane's episode runs under")
    seq: int = Field(description="the last seq answered; the next request carries seq + 1")
    time_limit: int | None
    penalty: float
    observation_space: BoxSpace
    action_space: ActionSpace
    outputs: list[str] = Field(description="what the model predicts, in the order of a step's deviations")
    idle_seconds: float = Field(description="the session expires when unused for so long")


class ResetSession(Request):
    seq: Seq | None = None
    seed: Seed | Annotated[list[Seed], Field(max_length=MAX_LANES)] | None = None
    mask: Annotated[list[bool], Field(max_length=MAX_LANES)] | None = Field(
        default=None, description="(N,) lanes to reset; None is all"
    )


class ResetReply(Reply):
    seq: int
    observation: list[list[float]] = Field(description="(N, D); lanes outside the mask show their last observation")
    model_version: list[int]


ActionRow = FiniteFloat | Annotated[list[FiniteFloat], Field(max_length=MAX_DIMENSIONS)]
Actions = Annotated[list[ActionRow], Field(min_length=1, max_length=MAX_LANES)]


class StepSession(Request):
    seq: Seq | None = None
    action: Actions = Field(description="(N, F), or (N,) where the action is one number")
    mask: Annotated[list[bool], Field(max_length=MAX_LANES)] | None = Field(
        default=None, description="(N,) lanes to step; None is all. Other lanes keep their state, with reward 0"
    )
    deviations: bool = Field(default=False, description="send the deviation of each output along")


class StepReply(Reply):
    """``final`` holds the last observation of lanes that ended and were reset within this very step (same_step)."""

    seq: int
    observation: list[list[float]]
    reward: list[float]
    terminated: list[bool]
    truncated: list[bool]
    final_lanes: list[int] = Field(default_factory=list, description="indices of lanes with a final observation")
    final_observation: list[list[float]] = Field(default_factory=list, description="(len(final_lanes), D)")
    model_version: list[int]
    reward_mean: list[float] = Field(description="(N,) before the penalty")
    deviation: list[list[float]] | None = Field(default=None, description="(N, O), when asked for")


class RolloutSession(Request):
    seq: Seq | None = None
    actions: Annotated[list[Actions], Field(min_length=1, max_length=MAX_ROLLOUT)] = Field(
        description="(T, N, F): T steps in one request"
    )


class RolloutReply(Reply):
    seq: int
    steps: list[StepReply]


class SubmitOccupancy(Request):
    checkpoint: Key


class SubmittedOccupancy(Reply):
    checkpoint: str
    states: int = Field(description="how many visited coordinates were stored")


# Service


class Health(Reply):
    status: Literal["ok"] = "ok"
    version: str
    protocol: int = PROTOCOL


class Ready(Reply):
    status: Literal["ready", "not_ready"]
    storage: str


class Event(Reply):
    """One server-sent event of a surrogate; ``id`` grows, so a reader goes on with Last-Event-ID."""

    id: int
    kind: Literal["created", "queries", "sample", "fit", "phase", "set_aside", "ledger"]
    created_at: float
    body: dict[str, Any]
