"""Wire models of policies: versions with their files, evaluations and aliases."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

from surrogym_shared.kinds import Side
from surrogym_shared.patterns import ALIAS, DIGEST, VISIBLE
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire.base import MAX_MEASURED, Key, Measured, Reply, Request, Vector

PolicyForm = Literal["zip", "onnx", "pt2", "mp4", "gif"]  # suffixes of policy files, and of videos of policies
Controller = Literal["policy", "zero", "random", "reference"]
TraceRank = Literal["paired", "best", "median", "worst"]  # paired: an episode from the same start for every controller
Digest = Annotated[str, Field(pattern=DIGEST, description="SHA-256 of the file, as hex")]
AliasName = Annotated[str, Field(pattern=ALIAS)]
Count = Annotated[int, Field(ge=0, le=2**53)]
Text = Annotated[str, Field(max_length=2_000, pattern=VISIBLE)]

FEWEST_TO_JUDGE = 30  # least number of episodes whose mean return is certain enough to judge a promised return
MAX_CURVE = 500
MAX_EPISODES = 10_000
MAX_TRACE = 10_000  # most steps of one episode's trace
MAX_TRACES = 16
CARD_DEPTH = 8  # most levels of nested lists and objects in the settings of a policy's training


class PolicyPromise(BaseModel):
    """Prediction of a policy's mean return over 100 real episodes: median, 5 % and 95 % quantile."""

    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)

    median: float = Field(description="median")
    low: float = Field(description="5 % quantile")
    high: float = Field(description="95 % quantile")
    functions: Count = Field(default=0, description="number of functions that were sampled from the posterior")
    episodes: Count = Field(default=0, description="number of virtual episodes")


class PolicyRangeLeft(BaseModel):
    """The end of a coordinate's sampling range that a policy's states exceed most often."""

    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)

    coordinate: Text = Field(description="name of the coordinate")
    side: Side = Field(description="the end of the range that the way passes")
    end: float = Field(description="value of this end")
    share: float = Field(description="share of the way's states beyond it")
    farthest: float = Field(description="the state farthest beyond it")


class PolicyAudit(BaseModel):
    """Result of an audit, which compares the model with real steps, most of them at states that the policy visits."""

    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)

    steps: Count = Field(description="number of real steps")
    elsewhere: Count = Field(
        default=0, description="how many of them were taken in gaps of the samples, off the policy's way"
    )
    passed: bool = Field(description="whether the model agrees with the real steps")
    faults: tuple[Text, ...] = Field(
        default=(), max_length=100, description="reasons why the audit failed; empty if it passed"
    )
    errors: dict[str, float] = Field(default={}, description="root mean square error of each output, in its unit")
    expected: dict[str, float] = Field(
        default={}, description="root mean square error that the model expected of each output, in its unit"
    )
    before: PolicyPromise | None = Field(default=None, description="promise before the audit")
    after: PolicyPromise | None = Field(
        default=None, description="promise of the model that has learned from the audit's steps"
    )
    range_left: PolicyRangeLeft | None = Field(
        default=None, description="where the policy's way leaves the sampling range; null if it hardly does"
    )


class PushedCard(BaseModel):
    """Card of a policy: settings and results of its training, as sent to the server. Unknown fields are dropped."""

    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)

    algorithm: Text = Field(default="", description="name of the policy search")
    spec: EnvironmentSpec | None = Field(default=None, description="specification that the policy was trained for")
    seed: Count | None = Field(default=None, description="seed of the training")
    virtual_steps: Count | None = Field(default=None, description="virtual steps of the training")
    model: Text = Field(default="", description="hash of the samples of the model that the promise is of")
    seconds: float | None = Field(default=None, description="duration of the training")
    imagined_return: float | None = Field(default=None, description="imagined return of the policy")
    untrained: float | None = Field(default=None, description="imagined return of an untrained network")
    promise: PolicyPromise | None = Field(default=None, description="promise of the policy")
    audit: PolicyAudit | None = Field(default=None, description="audit of the policy")
    trusted: bool | None = Field(default=None, description="verdict on the promise; null: none was made")
    reason: Text = Field(default="", description="reason of the verdict")
    networks: Count = Field(default=1, description="number of networks that the training tried")
    settings: dict[str, Any] = Field(default={}, description="settings of the training, by name")
    versions: dict[str, Text] = Field(default={}, description="versions of the packages of the training, by name")


class CurvePoint(BaseModel):
    """One point of a training's curve."""

    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)

    steps: Count = Field(description="virtual steps so far")
    imagined_return: float | None = Field(default=None, description="imagined return at this point")
    seconds: float | None = Field(default=None, description="seconds since the training began")


class FileNotice(Request):
    """Announcement of a file to be uploaded. The upload is accepted only if size and digest match."""

    form: PolicyForm = Field(description="form of the file, which is also the ending of its name")
    bytes: Annotated[int, Field(ge=1)] = Field(description="size of the file")
    digest: Digest


class AddPolicy(Request):
    """Request to store a policy: its card, its training curve, and the announcement of its file.

    A stored version never changes. The same file with another card or curve becomes a new version.
    """

    model_config = ConfigDict(extra="forbid", strict=False)  # the card checks its own types

    card: PushedCard = Field(description="settings and results of the training")
    curve: list[CurvePoint] = Field(default=[], max_length=MAX_CURVE, description="curve of the training")
    file: FileNotice = Field(description="announcement of the policy's file")

    @field_validator("card")
    @classmethod
    def _sane(cls, card: PushedCard) -> PushedCard:
        """Refuse numbers that are not finite or are too large, also in the settings, which may have any structure."""
        _require_sane("card", card.model_dump(exclude={"spec"}), CARD_DEPTH)
        promises = [card.promise, *((card.audit.before, card.audit.after) if card.audit else ())]
        for promise in [one for one in promises if one is not None]:
            if not promise.low <= promise.median <= promise.high:
                came = f"{promise.low:g}, {promise.median:g} and {promise.high:g}"
                raise ValueError(f"expected a promise with low <= median <= high, got {came}")
        return card

    @field_validator("curve")
    @classmethod
    def _sane_curve(cls, curve: list[CurvePoint]) -> list[CurvePoint]:
        _require_sane("curve", [point.model_dump() for point in curve], CARD_DEPTH)
        return curve


def _require_sane(place: str, value: Any, depth: int) -> None:
    """Raise ``ValueError`` unless a nested value has finite numbers of at most ``MAX_MEASURED``, text without NUL, and
    at most ``depth`` levels. ``place`` is its name in the message."""
    if depth < 0:
        raise ValueError(f"{place}: expected at most {CARD_DEPTH} levels of lists and objects, got more")
    if isinstance(value, dict):
        for name, each in value.items():
            _require_sane(f"{place}.{name}", each, depth - 1)
    elif isinstance(value, (list, tuple)):
        for number, each in enumerate(value):
            _require_sane(f"{place}.{number}", each, depth - 1)
    elif isinstance(value, (int, float)) and not abs(value) <= MAX_MEASURED:  # also true for NaN
        raise ValueError(f"{place}: expected a finite number of at most {MAX_MEASURED:g} in size, got {value:g}")
    elif isinstance(value, str) and "\0" in value:
        raise ValueError(f"{place}: expected text without the character NUL, got {value[:40]!r}")


class EpisodeTrace(Request):
    """States, actions and rewards of one real episode of T steps."""

    rank: TraceRank = Field(
        description="which episode it is: the best, median or worst of the evaluation, or ``paired``, from the "
        "same start for every controller"
    )
    seed: Count = Field(description="reset seed of the episode")
    coordinates: Annotated[list[Vector], Field(min_length=1, max_length=MAX_TRACE + 1)] = Field(
        description="(T + 1, C) states, the start included"
    )
    action: Annotated[list[Vector], Field(max_length=MAX_TRACE)] = Field(description="(T, F) actions")
    reward: Annotated[list[Measured], Field(max_length=MAX_TRACE)] = Field(description="(T,) rewards")


class AddEvaluation(Request):
    """Request to store the results of real episodes of a policy, or of another controller from the same starts.

    ``returns``, ``lengths`` and ``success`` have one entry for each episode.
    """

    controller: Controller = Field(
        default="policy",
        description="who chose the actions: the policy; nobody, so an action of ``zero`` or ``random`` actions; or "
        "a ``reference`` controller, such as the one in use",
    )
    note: Text = Field(default="", description="remark for people, such as which machine was used")
    declared: bool = Field(
        default=True,
        description="whether starts and machine are as the specification declares them; the promise is about those "
        "only",
    )
    environment: Text = Field(
        default="",
        description="name of the environment in which the episodes ran, such as ``module:Class``; empty: the "
        "surrogate's own",
    )
    seeded: bool = Field(
        default=True,
        description="whether a reset with the same seed repeats the start; otherwise the episodes are not compared "
        "with others start by start",
    )
    first_seed: Count = Field(description="reset seed of the first episode; each further episode has the next seed")
    returns: Annotated[list[Measured], Field(min_length=1, max_length=MAX_EPISODES)] = Field(
        description="return of each episode"
    )
    lengths: Annotated[list[Count], Field(min_length=1, max_length=MAX_EPISODES)] = Field(
        description="number of steps of each episode"
    )
    success: Annotated[list[bool], Field(max_length=MAX_EPISODES)] | None = Field(
        default=None, description="whether each episode was a success; null without a criterion in the specification"
    )
    traces: list[EpisodeTrace] = Field(
        default=[], max_length=MAX_TRACES, description="some of the episodes, step by step"
    )
    idempotency_key: Key = Field(description="a repeat with the same key adds nothing")


class PutAlias(Request):
    """Request to point an alias to a version."""

    version: Annotated[int, Field(ge=1, le=2**31 - 1)] = Field(description="version of the policy")


class PolicyFileView(Reply):
    """Description of a stored or announced file of a policy."""

    form: PolicyForm = Field(description="form of the file, which is also the ending of its name")
    bytes: int = Field(description="size of the file")
    digest: str = Field(description="SHA-256 of the file, as hex")
    stored: bool = Field(
        description="whether the server has the file; false: it was announced and has not arrived yet, or it was "
        "removed to free space"
    )


class Interval(Reply):
    """A 95 % interval."""

    low: float = Field(description="lower end")
    high: float = Field(description="upper end")


class EvaluationView(Reply):
    """Statistics of the real episodes of one evaluation."""

    id: int = Field(description="number of the evaluation")
    controller: Controller = Field(description="who chose the actions")
    created_at: float = Field(description="when it was stored, in seconds since 1970, by the server's clock")
    note: str = Field(description="remark for people")
    declared: bool = Field(description="whether starts and machine are as the specification declares them")
    environment: str = Field(description="name of the environment in which the episodes ran; empty: not known")
    own: bool = Field(
        description="whether that is the surrogate's own environment. If the surrogate names it by free text only, its "
        "own is the one of its first evaluation"
    )
    seeded: bool = Field(description="whether a reset with the same seed repeats the start")
    first_seed: int = Field(description="reset seed of the first episode")
    episodes: int = Field(description="number of episodes")
    steps: int = Field(description="number of real steps")
    mean: float = Field(description="mean return")
    mean_interval: Interval | None = Field(
        description="interval of the mean return over new starts; null for a single episode"
    )
    median: float = Field(
        description="return of the median episode; of an even number, the lower of the two middle ones"
    )
    least: float = Field(description="lowest return")
    most: float = Field(description="highest return")
    success_rate: float | None = Field(
        description="share of the episodes that were a success; null without a criterion in the specification"
    )
    success_interval: Interval | None = Field(description="interval of the success rate")
    promise_kept: bool | None = Field(
        description="whether the mean return is at least the promise's lower end; null without a promise, if "
        "the environment or the starts are not those of the promise, or with fewer than 30 episodes"
    )


class EvaluationDetail(EvaluationView):
    """An evaluation with all its episodes, and traces of some."""

    returns: list[float] = Field(description="return of each episode")
    lengths: list[int] = Field(description="number of steps of each episode")
    success: list[bool] | None = Field(description="whether each episode was a success")
    traces: list[EpisodeTrace] = Field(description="some of the episodes, step by step")
    missing: str | None = Field(default=None, description="why episodes and traces can't be read; null if they can")


class PolicyView(Reply):
    """One version of a surrogate's policies, with its files and evaluations."""

    version: int = Field(description="version number; it is never used again")
    created_at: float = Field(description="when it was stored, in seconds since 1970, by the server's clock")
    aliases: list[str] = Field(description="aliases that point to this version")
    algorithm: str = Field(description="name of the policy search")
    virtual_steps: int | None = Field(description="virtual steps of the training")
    imagined_return: float | None = Field(description="imagined return of the policy")
    promise: PolicyPromise | None = Field(description="promise of the policy")
    audit: PolicyAudit | None = Field(description="audit of the policy")
    trusted: bool | None = Field(
        description="verdict on the promise; false if the latest evaluation that judges it broke it, or if drift was "
        "found later; null: none was made"
    )
    reason: str = Field(description="reason of the verdict")
    drifted_at: float | None = Field(default=None, description="when drift was found, if the verdict rests on it")
    differs: str | None = Field(
        description="difference between the specification that the policy was trained for and the surrogate's; "
        "null if there is none"
    )
    pushed_by: str | None = Field(
        default=None,
        description="who stored it: role and fingerprint of the token, or ``anybody`` without tokens; null for "
        "policies of earlier programs",
    )
    files: list[PolicyFileView] = Field(description="files of the policy")
    evaluations: list[EvaluationView] = Field(
        description="real episodes of the policy, of no policy and of reference controllers"
    )


class PolicyDetail(PolicyView):
    """A policy with the settings and the curve of its training."""

    seed: int | None = Field(description="seed of the training")
    seconds: float | None = Field(description="duration of the training")
    model: str = Field(default="", description="hash of the samples of the model that the promise is of")
    untrained: float | None = Field(default=None, description="imagined return of an untrained network")
    settings: dict[str, Any] = Field(description="settings of the training, by name")
    versions: dict[str, str] = Field(description="versions of the packages of the training, by name")
    curve: list[CurvePoint] = Field(description="curve of the training")


class PushedPolicy(PolicyView):
    """Reply after a policy was stored."""

    created: bool = Field(
        description="whether this request created the version; false: the server had this file already"
    )


class PolicyList(Reply):
    """All policies of a surrogate."""

    policies: list[PolicyView] = Field(description="newest first")
