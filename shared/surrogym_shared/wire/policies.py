"""Wire models of policies: versions with their files, evaluations, reports of drift and aliases. A drift is a change
of the original environment since its model was learned."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from surrogym_shared.kinds import Side
from surrogym_shared.patterns import ALIAS, DIGEST, VISIBLE
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.wire.base import MAX_MEASURED, Key, Measured, Reply, Request, SurrogateName, Vector
from surrogym_shared.wire.queries import LimitCounts

# Formats of policy files (zip, onnx, pt2) and of videos of policies (mp4, gif).
PolicyForm = Literal["zip", "onnx", "pt2", "mp4", "gif"]
Controller = Literal["policy", "zero", "random", "reference"]
TraceRank = Literal["paired", "best", "median", "worst"]  # paired: an episode from the same start for every controller
Digest = Annotated[str, Field(pattern=DIGEST, description="SHA-256 of the file, as hex")]
AliasName = Annotated[str, Field(pattern=ALIAS)]
Count = Annotated[int, Field(ge=0, le=2**53)]
Text = Annotated[str, Field(max_length=2_000, pattern=VISIBLE)]

# With fewer episodes, an evaluation does not judge a policy's promise (predicted interval of the mean return).
FEWEST_TO_JUDGE = 30
MAX_CURVE = 500
MAX_EPISODES = 10_000
MAX_TRACE = 10_000  # largest number of steps in a trace (record of one episode's states, actions and rewards)
MAX_TRACES = 16
CARD_DEPTH = 8  # largest number of nested lists and objects in the settings of a policy's training


class PolicyFallback(BaseModel):
    """Prediction of the share of 100 real episodes in which the fallback of declared limits acts."""

    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)

    median: float = Field(description="median of the predicted share, from 0 to 1")
    low: float = Field(description="5 % quantile of the predicted share")
    high: float = Field(description="95 % quantile of the predicted share")
    mean: float | None = Field(default=None, description="expected share; null in older policies")


class PolicyPromise(BaseModel):
    """Prediction of a policy's mean return over 100 real episodes: median, 5 % and 95 % quantile."""

    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)

    median: float = Field(description="median of the predicted mean return")
    low: float = Field(description="5 % quantile of the predicted mean return")
    high: float = Field(description="95 % quantile of the predicted mean return")
    functions: Count = Field(default=0, description="number of functions sampled from the posterior for the prediction")
    episodes: Count = Field(default=0, description="number of virtual episodes that the prediction was computed from")
    fallback: PolicyFallback | None = Field(
        default=None, description="share of episodes in which the fallback of limits acts; null without limits"
    )


class PolicyRangeLeft(BaseModel):
    """The end of a coordinate's sampling range that the states of a policy exceed most often."""

    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)

    coordinate: Text = Field(description="name of the coordinate")
    side: Side = Field(description="the end of the sampling range that the policy's states exceed")
    end: float = Field(description="value of the coordinate at this end of the range")
    share: float = Field(description="share of the policy's states that lie beyond this end")
    farthest: float = Field(description="value of the coordinate farthest beyond this end")


class PolicyAudit(BaseModel):
    """Result of an audit, which compares the model with real steps, most of them at states that the policy visits."""

    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)

    steps: Count = Field(description="number of real steps of the audit")
    elsewhere: Count = Field(
        default=0,
        description="number of real steps in gaps between the samples, not at states that the policy visits",
    )
    passed: bool = Field(description="whether the model agrees with the real steps")
    faults: tuple[Text, ...] = Field(
        default=(), max_length=100, description="reasons why the audit failed; empty if it passed"
    )
    errors: dict[str, float] = Field(
        default={}, description="root mean square error of the predictions of each output, in the output's unit"
    )
    expected: dict[str, float] = Field(
        default={}, description="root mean square error of each output that the model expected, in the output's unit"
    )
    before: PolicyPromise | None = Field(
        default=None, description="promise (interval of the mean return) before the audit"
    )
    after: PolicyPromise | None = Field(
        default=None, description="promise of the model that has learned from the audit's steps"
    )
    range_left: PolicyRangeLeft | None = Field(
        default=None, description="where the policy's states leave the sampling range; null if hardly any do"
    )


class PushedCard(BaseModel):
    """Card of a policy: settings and results of its training, as sent to the server. Unknown fields are dropped."""

    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)

    algorithm: Text = Field(default="", description="name of the training algorithm")
    surrogate: SurrogateName | None = Field(
        default=None, description="surrogate that the policy was trained on; null: not known"
    )
    spec: EnvironmentSpec | None = Field(default=None, description="specification that the policy was trained for")
    seed: Count | None = Field(default=None, description="seed of the training")
    virtual_steps: Count | None = Field(default=None, description="virtual steps of the training")
    model: Text = Field(default="", description="hash of the samples of the model that predicted the promise")
    seconds: float | None = Field(default=None, description="duration of the training in seconds")
    imagined_return: float | None = Field(default=None, description="imagined return of the policy")
    untrained: float | None = Field(default=None, description="imagined return of an untrained network")
    promise: PolicyPromise | None = Field(default=None, description="predicted interval of the policy's mean return")
    audit: PolicyAudit | None = Field(default=None, description="audit of the policy")
    trusted: bool | None = Field(default=None, description="whether the promise is trusted; null: not decided")
    reason: Text = Field(default="", description="why the promise is trusted or not")
    networks: Count = Field(default=1, description="number of networks that the training tried")
    settings: dict[str, Any] = Field(default={}, description="settings of the training, by name")
    versions: dict[str, Text] = Field(default={}, description="versions of the packages of the training, by name")


class CurvePoint(BaseModel):
    """One point of a training's learning curve."""

    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)

    steps: Count = Field(description="virtual steps so far")
    imagined_return: float | None = Field(default=None, description="imagined return of the policy at this point")
    seconds: float | None = Field(default=None, description="seconds since the training began")


class FileNotice(Request):
    """Announcement of a file to be uploaded. The upload is accepted only if size and digest match."""

    form: PolicyForm = Field(description="format of the file, which is also the suffix of its name")
    bytes: Annotated[int, Field(ge=1)] = Field(description="size of the file in bytes")
    digest: Digest


class AddPolicy(Request):
    """Request to store a policy: its card, its learning curve, and the announcement of its file.

    A stored version never changes. The same file with another card or curve becomes a new version, unless only the
    trust in the card is another.
    """

    # Not strict here, because ``PushedCard`` checks the types of its fields.
    model_config = ConfigDict(extra="forbid", strict=False)

    card: PushedCard = Field(description="settings and results of the training")
    curve: list[CurvePoint] = Field(default=[], max_length=MAX_CURVE, description="learning curve of the training")
    file: FileNotice = Field(description="announcement of the policy's file")

    @field_validator("card")
    @classmethod
    def _sane(cls, card: PushedCard) -> PushedCard:
        """Return the card. Refuse numbers in it that are not finite or too large, also in the settings, and a promise
        whose quantiles are not in order."""
        _require_sane("card", card.model_dump(exclude={"spec"}), CARD_DEPTH)
        promises = [card.promise, *((card.audit.before, card.audit.after) if card.audit else ())]
        for promise in [one for one in promises if one is not None]:
            if not promise.low <= promise.median <= promise.high:
                came = f"{promise.low:g}, {promise.median:g} and {promise.high:g}"
                raise ValueError(f"card: expected a promise with low <= median <= high, got {came}")
        return card

    @field_validator("curve")
    @classmethod
    def _sane_curve(cls, curve: list[CurvePoint]) -> list[CurvePoint]:
        _require_sane("curve", [point.model_dump() for point in curve], CARD_DEPTH)
        return curve


def _require_sane(place: str, value: Any, depth: int) -> None:
    """Raise ``ValueError`` unless a value of lists and objects has only finite numbers of at most ``MAX_MEASURED``,
    text without NUL, and at most ``depth`` nested levels. ``place`` is the value's name in the message."""
    if depth < 0:
        raise ValueError(f"{place}: expected at most {CARD_DEPTH} levels of lists and objects, got more")
    if isinstance(value, dict):
        for name, each in value.items():
            _require_sane(f"{place}.{name}", each, depth - 1)
    elif isinstance(value, (list, tuple)):
        for number, each in enumerate(value):
            _require_sane(f"{place}.{number}", each, depth - 1)
    elif isinstance(value, (int, float)) and not abs(value) <= MAX_MEASURED:  # ``not <=`` is also true for NaN
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
        description="(T + 1, C) states, beginning with the start"
    )
    action: Annotated[list[Vector], Field(max_length=MAX_TRACE)] = Field(description="(T, F) action of each step")
    reward: Annotated[list[Measured], Field(max_length=MAX_TRACE)] = Field(description="(T,) reward of each step")


class AddEvaluation(Request):
    """Request to store the results of real episodes of a policy, or of another controller from the same starts.

    ``returns``, ``lengths`` and ``success`` have one entry for each episode.
    """

    controller: Controller = Field(
        default="policy",
        description="what chose the actions: the policy, a constant action of ``zero``, ``random`` choice, or a "
        "``reference`` controller, such as the one in use",
    )
    note: Text = Field(default="", description="remark for people, such as which machine was used")
    declared: bool = Field(
        default=True,
        description="whether starts and machine are as the specification declares them; otherwise the evaluation does "
        "not judge the promise",
    )
    environment: Text = Field(
        default="",
        description="name of the environment in which the episodes ran, such as ``module:Class``; empty: the "
        "surrogate's own",
    )
    seeded: bool = Field(
        default=True,
        description="whether a reset with the same seed repeats the start; if not, the episodes are not compared with "
        "those of another controller from the same start",
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
        default=[], max_length=MAX_TRACES, description="states, actions and rewards of some episodes"
    )
    limits: LimitCounts | None = Field(
        default=None, description="how all episodes kept the limits of the specification; null without limits"
    )
    idempotency_key: Key = Field(description="a repeat with the same key adds nothing")

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if self.limits is not None:
            self.limits.require_fit(len(self.returns), sum(self.lengths))
        return self


class PutAlias(Request):
    """Request to point an alias to a version."""

    version: Annotated[int, Field(ge=1, le=2**31 - 1)] = Field(description="version of the policy")


class PolicyFileView(Reply):
    """Description of a stored or announced file of a policy."""

    form: PolicyForm = Field(description="format of the file, which is also the suffix of its name")
    bytes: int = Field(description="size of the file in bytes")
    digest: str = Field(description="SHA-256 of the file, as hex")
    stored: bool = Field(
        description="whether the server has the file; false: it was announced and has not arrived yet, or it was "
        "removed to free space"
    )


class Interval(Reply):
    """A 95 % interval."""

    low: float = Field(description="lower end")
    high: float = Field(description="upper end")


class EvaluationLimits(Reply):
    """How the real episodes of one evaluation kept the limits of their specification."""

    violations: int = Field(description="number of episodes that left a limit")
    fallbacks: int = Field(description="number of steps in which the fallback acted")
    fallback_episodes: int = Field(description="number of episodes with such a step")
    kept: bool = Field(
        description="false if more episodes left a limit than the allowed probability explains, or more had a fallback "
        "than the policy's promise expected; exact tests at 5 and 2.5 %"
    )
    said: str = Field(description="these counts in a sentence, with an exact 95 % interval of the share of violations")


class EvaluationView(Reply):
    """Statistics of the real episodes of one evaluation."""

    id: int = Field(description="number of the evaluation")
    controller: Controller = Field(
        description="what chose the actions: the policy, zero, random or a reference controller"
    )
    created_at: float = Field(description="when it was stored, in seconds since 1970, by the server's clock")
    note: str = Field(description="remark for people")
    declared: bool = Field(description="whether starts and machine are as the specification declares them")
    environment: str = Field(description="name of the environment in which the episodes ran; empty: not known")
    own: bool = Field(
        description="whether the episodes ran in the surrogate's own environment. If the specification describes it by "
        "free text only, it is the environment of the surrogate's first evaluation"
    )
    seeded: bool = Field(description="whether a reset with the same seed repeats the start")
    first_seed: int = Field(description="reset seed of the first episode")
    episodes: int = Field(description="number of episodes")
    steps: int = Field(description="number of real steps")
    mean: float = Field(description="mean return")
    mean_interval: Interval | None = Field(
        description="95 % interval of the mean return over new starts; null for a single episode"
    )
    median: float = Field(
        description="return of the median episode; of an even number, the lower of the two middle ones"
    )
    least: float = Field(description="lowest return")
    most: float = Field(description="highest return")
    success_rate: float | None = Field(
        description="share of the episodes that were a success; null without a criterion in the specification"
    )
    success_interval: Interval | None = Field(description="95 % interval of the success rate; null without a criterion")
    promise_kept: bool | None = Field(
        description="whether the mean return is at least the lower end of the policy's promise; null without a "
        "promise, with fewer than 30 episodes, or if the environment or the starts are other ones"
    )
    limits: EvaluationLimits | None = Field(
        default=None, description="how the episodes kept declared limits; null if none were reported"
    )
    pushed_by: str | None = Field(default=None, description="who stored it, as for a policy")


class EvaluationDetail(EvaluationView):
    """An evaluation with the results of all its episodes, and with states, actions and rewards of some."""

    returns: list[float] = Field(description="return of each episode")
    lengths: list[int] = Field(description="number of steps of each episode")
    success: list[bool] | None = Field(description="whether each episode was a success")
    traces: list[EpisodeTrace] = Field(description="states, actions and rewards of some episodes")
    missing: str | None = Field(
        default=None, description="why the results of the episodes can't be read; null if they can"
    )


class PolicyView(Reply):
    """One version of a surrogate's policies, with its files and evaluations."""

    version: int = Field(description="number of the version: 1, 2, ...; a deleted number is not used again")
    created_at: float = Field(description="when it was stored, in seconds since 1970, by the server's clock")
    aliases: list[str] = Field(description="aliases that point to this version")
    algorithm: str = Field(description="name of the training algorithm")
    virtual_steps: int | None = Field(description="virtual steps of the training")
    imagined_return: float | None = Field(description="imagined return of the policy")
    promise: PolicyPromise | None = Field(description="predicted interval of the policy's mean return")
    audit: PolicyAudit | None = Field(description="audit of the policy")
    trusted: bool | None = Field(
        description="whether the promise is trusted; false if the mean return of the latest evaluation that can judge "
        "it is lower, if the latest one did not keep the limits, or if drift was reported later; null: not decided"
    )
    reason: str = Field(description="why the promise is trusted or not")
    drifted_at: float | None = Field(
        default=None,
        description="when drift was reported, in seconds since 1970; null if trust does not depend on drift",
    )
    origin: str | None = Field(
        default=None,
        description="NAME@VERSION of the same policy at the surrogate of its training, if that is another one: its "
        "evaluations and reports of drift there are in this reply too, and decide on the trust here",
    )
    differs: str | None = Field(
        description="difference between the specification that the policy was trained for and the surrogate's; "
        "null if there is none"
    )
    pushed_by: str | None = Field(
        default=None,
        description="who stored the policy: role and fingerprint of the token, or ``anybody`` without tokens; null if "
        "an earlier version of the server stored it",
    )
    files: list[PolicyFileView] = Field(description="files of the policy")
    evaluations: list[EvaluationView] = Field(
        description="real episodes of the policy, and of other controllers from the same starts"
    )


class PolicyDetail(PolicyView):
    """A policy with the settings and the learning curve of its training."""

    seed: int | None = Field(description="seed of the training")
    seconds: float | None = Field(description="duration of the training in seconds")
    model: str = Field(default="", description="hash of the samples of the model that predicted the promise")
    untrained: float | None = Field(default=None, description="imagined return of an untrained network")
    settings: dict[str, Any] = Field(description="settings of the training, by name")
    versions: dict[str, str] = Field(description="versions of the packages of the training, by name")
    curve: list[CurvePoint] = Field(description="learning curve of the training")


class PushedPolicy(PolicyView):
    """Reply after a policy was stored."""

    created: bool = Field(
        description="whether this request created the version; false: the same file, card and curve were stored before"
    )


class PolicyList(Reply):
    """All policies of a surrogate."""

    policies: list[PolicyView] = Field(description="policies of the surrogate, newest first")


class AddDrift(Request):
    """Report that real steps no longer agree with the model, so that the return that a policy's promise predicts is not
    trusted."""

    output: Text = Field(description="name of the output that differs most")
    error: Measured = Field(
        description="mean of real minus predicted values of the output, in its unit; or the root mean square, if the "
        "errors have grown in both directions"
    )
    words: Text = Field(description="the error and the region in which it was found, for people")
    steps: Count = Field(description="number of real steps that were compared with the model until drift was found")
    idempotency_key: Key = Field(description="a repeat with the same key adds nothing")
