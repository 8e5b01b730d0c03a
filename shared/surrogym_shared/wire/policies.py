"""Wire models of policies: versions with their files, evaluations and aliases."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire.base import VISIBLE, Key, Measured, Reply, Request, Vector

PolicyForm = Literal["zip", "onnx", "pt2", "mp4", "gif"]  # endings of policy files
Controller = Literal["policy", "zero", "random", "reference"]
TraceRank = Literal["paired", "best", "median", "worst"]  # paired: from the same start for every controller
Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$", description="SHA-256 of the file, as hex")]
AliasName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_-]{0,31}$")]
Count = Annotated[int, Field(ge=0, le=2**53)]
Text = Annotated[str, Field(max_length=2_000, pattern=VISIBLE)]

MAX_CURVE = 500
MAX_EPISODES = 10_000
MAX_TRACE = 10_000  # most steps of one episode's trace
MAX_TRACES = 16


class PolicyPromise(BaseModel):
    """Mean return over 100 real starts that the surrogate predicts: median, 5 % and 95 % quantile."""

    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)

    median: float
    low: float
    high: float
    functions: Count = Field(default=0, description="how many functions of the posterior were drawn")
    episodes: Count = Field(default=0, description="how many virtual episodes were run")


class PolicyAudit(BaseModel):
    """Result of comparing the model with real steps on the policy's way."""

    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)

    steps: Count
    passed: bool
    faults: tuple[Text, ...] = Field(default=(), max_length=100)
    errors: dict[str, float] = Field(default={}, description="root mean square by output, in its unit")
    expected: dict[str, float] = Field(default={}, description="the same, as the model expected it")
    before: PolicyPromise | None = None
    after: PolicyPromise | None = None


class PushedCard(BaseModel):
    """Settings and results of a policy's training. Unknown fields are dropped."""

    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)

    algorithm: Text = ""
    spec: EnvironmentSpec | None = None
    seed: Count | None = None
    virtual_steps: Count | None = None
    seconds: float | None = None
    imagined_return: float | None = None
    untrained: float | None = Field(default=None, description="imagined return of an untrained network")
    promise: PolicyPromise | None = None
    audit: PolicyAudit | None = None
    trusted: bool | None = None
    reason: Text = ""
    networks: Count = 1
    settings: dict[str, Any] = {}
    versions: dict[str, Text] = {}


class CurvePoint(BaseModel):
    """One point of a training's curve."""

    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)

    steps: Count
    imagined_return: float | None = None
    seconds: float | None = None


class FileNotice(Request):
    """Announcement of a file. The upload is accepted only if it is exactly this file."""

    form: PolicyForm
    bytes: Annotated[int, Field(ge=1)]
    digest: Digest


class AddPolicy(Request):
    """A policy: its card, its training curve, and the announcement of its file.

    If the server has this file already, the policy keeps its version, and its card and curve are replaced.
    """

    model_config = ConfigDict(extra="forbid", strict=False)  # the card validates its own types

    card: PushedCard
    curve: list[CurvePoint] = Field(default=[], max_length=MAX_CURVE)
    file: FileNotice


class EpisodeTrace(Request):
    """One real episode of T steps."""

    rank: TraceRank
    seed: Count
    coordinates: Annotated[list[Vector], Field(min_length=1, max_length=MAX_TRACE + 1)] = Field(
        description="(T + 1, C), the start included"
    )
    action: Annotated[list[Vector], Field(max_length=MAX_TRACE)] = Field(description="(T, F)")
    reward: Annotated[list[Measured], Field(max_length=MAX_TRACE)] = Field(description="(T,)")


class AddEvaluation(Request):
    """Add the results of real episodes: of a policy, or of a baseline that ran the same starts.

    ``returns``, ``lengths`` and ``success`` have one entry for each episode.
    """

    controller: Controller = Field(
        default="policy",
        description="who acted: the policy, a constant action of zero, random actions, or a controller of reference",
    )
    note: Text = Field(default="", description="which starts, of which machine")
    declared: bool = Field(
        default=True, description="whether starts and machine are as the specification says; the promise is about those"
    )
    first_seed: Count
    returns: Annotated[list[Measured], Field(min_length=1, max_length=MAX_EPISODES)]
    lengths: Annotated[list[Count], Field(min_length=1, max_length=MAX_EPISODES)]
    success: Annotated[list[bool], Field(max_length=MAX_EPISODES)] | None = None
    traces: list[EpisodeTrace] = Field(default=[], max_length=MAX_TRACES)
    idempotency_key: Key


class PutAlias(Request):
    version: Annotated[int, Field(ge=1, le=2**31 - 1)]


class PolicyFileView(Reply):
    form: PolicyForm
    bytes: int
    digest: str
    stored: bool = Field(description="false: announced and not yet sent, or removed to make room")


class Interval(Reply):
    """A 95 % interval."""

    low: float
    high: float


class EvaluationView(Reply):
    """Statistics of real episodes."""

    id: int
    controller: Controller
    created_at: float
    note: str
    declared: bool
    first_seed: int
    episodes: int
    steps: int = Field(description="real steps that it took")
    mean: float
    mean_interval: Interval | None = Field(description="of the mean return over new starts; None for one episode")
    median: float
    least: float
    most: float
    success_rate: float | None = Field(description="None where the specification has no criterion")
    success_interval: Interval | None
    promise_kept: bool | None = Field(
        description="whether the mean is at least the promise's lower end; None without a promise, or where the starts "
        "are others than the promise's"
    )


class EvaluationDetail(EvaluationView):
    """An evaluation with all its episodes, and traces of some."""

    returns: list[float]
    lengths: list[int]
    success: list[bool] | None
    traces: list[EpisodeTrace]
    missing: str | None = Field(default=None, description="why episodes and traces can't be read; None: they are there")


class PolicyView(Reply):
    """One version of a surrogate's policies."""

    version: int
    created_at: float
    aliases: list[str]
    algorithm: str
    virtual_steps: int | None
    imagined_return: float | None
    promise: PolicyPromise | None
    audit: PolicyAudit | None
    trusted: bool | None = Field(description="None: nobody checked whether the promise can be trusted")
    reason: str
    differs: str | None = Field(
        description="where the specification that it was made for differs from the surrogate's; None: it does not"
    )
    files: list[PolicyFileView]
    evaluations: list[EvaluationView]


class PolicyDetail(PolicyView):
    """A policy with the settings and the curve of its training."""

    seed: int | None
    seconds: float | None
    settings: dict[str, Any]
    versions: dict[str, str]
    curve: list[CurvePoint]


class PushedPolicy(PolicyView):
    created: bool = Field(description="whether this request made the version; false: its file is known")


class PolicyList(Reply):
    policies: list[PolicyView] = Field(description="newest first")
