"""Wire models of sessions: open, reset, step, rollout, occupancy."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, FiniteFloat, model_validator

from surrogym_shared.acting import MAX_UNITS
from surrogym_shared.network import MAX_LAYERS, Activation
from surrogym_shared.spec import MAX_DIMENSIONS
from surrogym_shared.wire.base import (
    MAX_LANES,
    MAX_PARTICLES,
    MAX_ROLLOUT,
    PROTOCOL,
    AutoresetMode,
    Key,
    Reply,
    Request,
    Seed,
    Seq,
    Variant,
)

OF_PARTICLES = ("particles", "propagation", "weighting", "spread")


class OpenSession(Request):
    """Options of a session: the virtual environment of one trainer.

    For ``time_limit`` and ``penalty``, None takes the surrogate's value. Each other field says what its None means.
    """

    num_envs: Annotated[int, Field(ge=1, le=MAX_LANES)] = 1
    variant: Variant = "deterministic"
    seed: Seed | None = Field(default=None, description="None draws one; the reply says which")
    autoreset_mode: AutoresetMode = "next_step"
    model: Annotated[int, Field(ge=1)] | Literal["latest"] = "latest"
    time_limit: Annotated[int, Field(ge=1, le=10_000_000)] | None = Field(default=None, description="None: the spec's")
    penalty: Annotated[float, Field(ge=0, le=100)] | None = Field(default=None, description="k of eq. 14")
    start_box: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.0, description="share of episodes that start anywhere in the sampling range"
    )
    process_noise: bool = Field(default=False, description="the learned noise moves the state")
    trust: Annotated[float, Field(gt=0, le=1_000)] | None = Field(
        default=None,
        description="truncate an episode when an output's predicted standard deviation exceeds this factor times the "
        "output's standard deviation in the samples; None: no limit",
    )
    particles: Annotated[int, Field(ge=1, le=MAX_PARTICLES)] = Field(
        default=1_000, description="of a lane; this and the next three are the probabilistic variant's"
    )
    propagation: Literal["mean", "sample"] = Field(
        default="sample", description="a particle moves by the mean, or by a draw of its own"
    )
    weighting: Literal["inverse_variance", "uniform"] = Field(
        default="inverse_variance", description="of the particles' rewards"
    )
    spread: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.01, description="initial deviation of particles, as a share of each coordinate's sampling range"
    )
    functions: Annotated[int, Field(ge=1, le=MAX_LANES)] | None = Field(
        default=None,
        description="variant pathwise: number of functions; lane i follows function i modulo it, so that lanes "
        "share functions from different starts; None: one function for each lane",
    )
    occupancy: bool = Field(default=False, description="collect visited coordinates, to be submitted at checkpoints")
    idempotency_key: Key | None = None

    @model_validator(mode="after")
    def _particles_are_the_probabilistic_variants(self) -> Self:
        """Refuse options that the chosen variant would ignore."""
        for name in () if self.variant == "probabilistic" else OF_PARTICLES:
            if getattr(self, name) != type(self).model_fields[name].default:
                raise ValueError(f"{name}: expected with variant probabilistic alone, got with {self.variant}")
        if self.functions is not None and self.variant != "pathwise":
            raise ValueError(f"functions: expected with variant pathwise alone, got with {self.variant}")
        return self


class SessionCoordinates(Reply):
    coordinates: list[list[float]] = Field(description="(N, C) where each lane is now; of particles their mean")


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
    model: int | Literal["latest"]
    model_version: list[int] = Field(description="(N,) the version each lane's episode runs under")
    seq: int = Field(description="the last seq answered; the next request carries seq + 1")
    time_limit: int | None
    penalty: float
    observation_space: BoxSpace
    action_space: ActionSpace
    outputs: list[str] = Field(description="what the model predicts, in the order of a step's deviations")
    idle_seconds: float = Field(description="the session expires when unused for so long")
    replay: int = Field(
        default=0,
        description="how many of its last requests a client should keep: after a crash the server may wait for a lower "
        "seq than the client's next one, and the client sends the requests from there again; 0: never",
    )


class SessionActivity(Reply):
    """Activity of a session since this server process knows it."""

    id: str
    num_envs: int
    variant: Variant
    model: Literal["latest"] | int
    model_version: list[int] = Field(description="model versions that its lanes use now, each once")
    steps: int = Field(description="of all lanes")
    steps_per_second: float = Field(description="of all lanes, over about the last ten seconds")
    idle_seconds: float = Field(description="since its last step")
    penalty: float = Field(description="k of eq. 14")
    episodes: int = Field(description="that ended")
    returns: list[float] = Field(description="imagined, of the last episodes that ended, oldest first")
    penalties: list[float] = Field(description="penalty for deviations that was subtracted from each of them")


class SessionList(Reply):
    sessions: list[SessionActivity]


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
    """Result of a step. ``final`` has the last observation of lanes that ended and were reset in this step (mode
    same_step)."""

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
    untrusted: list[bool] | None = Field(
        default=None, description="(N,) lanes truncated for leaving the trusted range, in a session that has one"
    )


Numbers = Annotated[list[FiniteFloat], Field(min_length=1, max_length=MAX_UNITS)]


class PolicyLayer(Request):
    """One layer of a network: x @ weights + bias."""

    weights: Annotated[list[Numbers], Field(min_length=1, max_length=MAX_UNITS)] = Field(description="(I, O)")
    bias: Numbers = Field(description="(O,)")


class PolicyArrays(Request):
    """Network that acts on standardised observations. The session's action space determines what its outputs mean.

    Continuous actions: the centre of the bounds plus half their width times tanh(y), plus noise, clipped to the bounds.
    Discrete actions: scores of the choices of each entry. With noise, choices are drawn by softmax; without, the
    highest score wins.
    """

    mean: Numbers = Field(description="(D,) subtracted from an observation")
    deviation: Numbers = Field(description="(D,) which divides the difference")
    layers: Annotated[list[PolicyLayer], Field(min_length=1, max_length=MAX_LAYERS)]
    activation: Activation = Field(default="tanh", description="of the hidden layers")
    log_deviations: Numbers | None = Field(
        default=None, description="(F,) logarithms of the deviations of continuous actions; needed for noise"
    )
    precision: Literal["float32", "float64"] = Field(default="float32", description="that the network computes in")


class ActionNoise(Request):
    """Key of the actions' noise. The same key, lane and entry give the same number."""

    seed: Seed
    step: Seed = Field(default=0, description="number of the rollout's first step; the next has the next number")


class RolloutSession(Request):
    """Rollout of given ``actions``, or of a ``policy`` for a number of ``steps``."""

    seq: Seq | None = None
    actions: Annotated[list[Actions], Field(min_length=1, max_length=MAX_ROLLOUT)] | None = Field(
        default=None, description="(T, N, F): T steps in one request"
    )
    policy: PolicyArrays | None = Field(default=None, description="acts in all lanes, on the server")
    steps: Annotated[int, Field(ge=1, le=MAX_ROLLOUT)] | None = Field(
        default=None, description="T with a policy, at most"
    )
    noise: ActionNoise | None = Field(default=None, description="of the policy's actions; None: the most probable ones")
    until: Annotated[list[bool], Field(max_length=MAX_LANES)] | None = Field(
        default=None,
        description="(N,) lanes; a policy's rollout stops after the step by which an episode has ended in each of them",
    )

    @model_validator(mode="after")
    def _actions_or_a_policy(self) -> Self:
        if (self.actions is None) == (self.policy is None):
            got = "neither" if self.actions is None else "both"
            raise ValueError(f"expected either actions or a policy, got {got}")
        if (self.policy is None) != (self.steps is None):
            raise ValueError("expected steps with a policy, and only with one")
        if self.policy is None and (self.noise or self.until is not None):
            raise ValueError("expected noise and until with a policy alone, got them with actions")
        return self


class RolloutReply(Reply):
    seq: int
    steps: list[StepReply]
    action: list[list[list[float]]] | None = Field(
        default=None, description="(T, N, F) of the policy, before it is clipped to its bounds"
    )
    log_probability: list[list[float]] | None = Field(default=None, description="(T, N) of each action, with noise")


class SubmitOccupancy(Request):
    checkpoint: Key


class SubmittedOccupancy(Reply):
    checkpoint: str
    states: int = Field(description="how many visited coordinates were stored")
    confidence_index: float | None = Field(
        default=None,
        description="of the session's model over these states under random actions: the smallest over outputs, with "
        "tolerances. None: there is no design here",
    )
