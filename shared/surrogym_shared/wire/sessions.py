"""Wire models of sessions: open, reset, step, rollout, occupancy."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, FiniteFloat, model_validator

from surrogym_shared.checks import LARGEST, Number
from surrogym_shared.kinds import Activation
from surrogym_shared.policy_sizes import MAX_LAYERS, MAX_UNITS
from surrogym_shared.spec import MAX_DIMENSIONS
from surrogym_shared.wire.base import (
    MAX_DRAWS,
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

OF_PARTICLES = ("particles", "spread")


Residuals = Annotated[list[FiniteFloat], Field(min_length=1, max_length=4 * MAX_DIMENSIONS)]


class Residual(Request):
    """Systematic errors of a model, which a session adds to its predictions: affine functions of state and action.

    The P inputs are the coordinates, in their order, with cosine and sine in place of an angle, and then the entries of
    the action. Each input is standardised by ``centre`` and ``scale``, and limited to three standard deviations.
    """

    centre: Residuals = Field(description="(P,) value of each input that is standardised to 0")
    scale: Residuals = Field(description="(P,) number by which the input minus ``centre`` is divided")
    weights: Annotated[
        list[Annotated[list[Residuals], Field(min_length=1, max_length=MAX_DIMENSIONS)]],
        Field(min_length=1, max_length=MAX_DRAWS),
    ] = Field(
        description="(K, O, 1 + P) K sets of a constant and P weights for each of O outputs, in the order of the "
        "session's ``outputs``; lane i uses set i modulo K"
    )


class OpenSession(Request):
    """Request to open a session, the virtual environment of one trainer, with its options.

    If ``time_limit`` or ``penalty`` is null, the value of the surrogate's specification is used.
    """

    num_envs: Annotated[int, Field(ge=1, le=MAX_LANES)] = Field(default=1, description="number of lanes, N")
    variant: Variant = Field(
        default="deterministic",
        description="how the state moves: by the model's mean, as particles, or along a sampled function",
    )
    seed: Seed | None = Field(
        default=None,
        description="seed of all random numbers of the session; null: the server draws one, and the reply names it",
    )
    autoreset_mode: AutoresetMode = Field(
        default="next_step", description="when a lane is reset after the end of its episode, as in Gymnasium"
    )
    model: Annotated[int, Field(ge=1)] | Literal["latest"] = Field(
        default="latest",
        description="version of the model; ``latest``: each episode uses the version that is the newest at its reset",
    )
    time_limit: Annotated[int, Field(ge=1, le=10_000_000)] | None = Field(
        default=None, description="steps after which an episode is truncated; null: the surrogate's time limit"
    )
    penalty: Annotated[float, Field(ge=0, le=100)] | None = Field(
        default=None,
        description="k: this number of predicted standard deviations of the reward is subtracted from it (eq. 14 of "
        "Active Uncertainty Reduction); null: the surrogate's penalty",
    )
    start_box: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.0, description="share of episodes that start anywhere in the sampling ranges"
    )
    start_visited: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.0,
        description="share of episodes that start at the state of a sample that was stored before the session was "
        "opened",
    )
    process_noise: bool = Field(default=False, description="whether the learned noise of a step is added to the state")
    sensor_noise: dict[str, Annotated[FiniteFloat, Field(ge=0, le=LARGEST)]] = Field(
        default={},
        description="standard deviation of the measurement error that is added to each named coordinate in "
        "observations. It does not move the state, so this part of the learned noise is left out of ``process_noise``",
    )
    set_points: dict[str, Number] = Field(
        default={},
        description="set points of coordinates, in the place of the values from which the declared reward measures "
        "their errors; empty: the reward as declared",
    )
    trust: Annotated[float, Field(gt=0, le=1_000)] | None = Field(
        default=None,
        description="truncate an episode if the predicted standard deviation of an output exceeds this factor times "
        "the output's standard deviation in the samples; null: no such limit",
    )
    particles: Annotated[int, Field(ge=1, le=MAX_PARTICLES)] = Field(
        default=1_000, description="variant probabilistic: number of particles in each lane"
    )
    spread: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.01,
        description="variant probabilistic: initial standard deviation of the particles, as a share of each "
        "coordinate's sampling range",
    )
    functions: Annotated[int, Field(ge=1, le=MAX_LANES)] | None = Field(
        default=None,
        description="variant pathwise: number of sampled functions; lane i follows function i modulo this number, so "
        "that lanes share functions from different starts; null: one function for each lane",
    )
    residual: Residual | None = Field(
        default=None,
        description="systematic errors to add to each prediction, such as errors found by real steps; null: none",
    )
    occupancy: bool = Field(
        default=False,
        description="whether to collect the visited states, which can then be submitted under the name of a checkpoint",
    )
    idempotency_key: Key | None = Field(
        default=None,
        description="a repeat with the same key opens no second session; null: each request opens a new one",
    )

    @model_validator(mode="after")
    def _shares_of_starts_fit(self) -> Self:
        if (both := self.start_box + self.start_visited) > 1:
            raise ValueError(
                f"start_box + start_visited: expected a sum of at most 1, as both are shares of the episodes, got "
                f"{both:g}"
            )
        return self

    @model_validator(mode="after")
    def _particles_are_the_probabilistic_variants(self) -> Self:
        """Refuse options that the chosen variant would ignore."""
        for name in () if self.variant == "probabilistic" else OF_PARTICLES:
            if getattr(self, name) != type(self).model_fields[name].default:
                raise ValueError(
                    f"{name}: expected variant probabilistic, the only one with this option, got {self.variant}"
                )
        if self.residual is not None and self.variant == "probabilistic":
            raise ValueError("residual: expected variant deterministic or pathwise, got probabilistic")
        if self.functions is not None and self.variant != "pathwise":
            raise ValueError(f"functions: expected variant pathwise, the only one with this option, got {self.variant}")
        return self


class SessionCoordinates(Reply):
    """The present state of each lane of a session."""

    coordinates: list[list[float]] = Field(
        description="(N, C) state of each lane; the mean of its particles in the variant probabilistic"
    )


class BoxSpace(Reply):
    """Space of vectors of real numbers, each within its limits."""

    kind: Literal["box"] = "box"
    low: list[float | None] = Field(description="lowest value of each entry; null: no limit")
    high: list[float | None] = Field(description="highest value of each entry; null: no limit")
    dtype: Literal["float32"] = "float32"


class DiscreteSpace(Reply):
    """Space of the whole numbers from 0 to n - 1."""

    kind: Literal["discrete"] = "discrete"
    n: int = Field(description="number of choices")


class MultiDiscreteSpace(Reply):
    """Space of vectors of whole numbers. Entry i is between 0 and nvec[i] - 1."""

    kind: Literal["multi_discrete"] = "multi_discrete"
    nvec: list[int] = Field(description="number of choices of each entry")


ActionSpace = Annotated[BoxSpace | DiscreteSpace | MultiDiscreteSpace, Field(discriminator="kind")]


class SessionView(Reply):
    """An open session: its options, its spaces, and the number of its last request."""

    protocol: int = Field(default=PROTOCOL, description="version of the HTTP protocol")
    id: str = Field(description="id of the session, which its requests name")
    surrogate: str = Field(description="name of the surrogate")
    num_envs: int = Field(description="number of lanes, N")
    variant: Variant
    seed: int = Field(description="seed of all random numbers of the session")
    autoreset_mode: AutoresetMode
    model: int | Literal["latest"] = Field(description="version of the model that was chosen, or ``latest``")
    model_version: list[int] = Field(description="(N,) version of the model that each lane's episode runs under")
    seq: int = Field(description="number of the last answered request; the next request has seq + 1")
    time_limit: int | None = Field(description="steps after which an episode is truncated; null: no limit")
    penalty: float = Field(
        description="number of predicted standard deviations that are subtracted from a reward (k of eq. 14)"
    )
    observation_space: BoxSpace
    action_space: ActionSpace
    outputs: list[str] = Field(
        description="names of the outputs (quantities that the model predicts), in the order of ``deviation`` in a "
        "reply"
    )
    idle_seconds: float = Field(description="seconds without a request after which the session expires")
    replay: int = Field(
        default=0,
        description="number of last requests that a client should keep. After a crash the server may expect a lower "
        "``seq`` than the client's next one. The client then repeats its requests from this ``seq``. 0: the server "
        "never expects repeats",
    )


class SessionActivity(Reply):
    """Virtual steps and imagined returns of a session since this server process opened or restored it."""

    id: str = Field(description="id of the session")
    num_envs: int = Field(description="number of lanes")
    variant: Variant
    model: Literal["latest"] | int = Field(description="version of the model that was chosen, or ``latest``")
    model_version: list[int] = Field(description="versions of the model that the lanes use now, each listed once")
    steps: int = Field(description="virtual steps so far, summed over lanes")
    steps_per_second: float = Field(
        description="virtual steps per second, summed over lanes, averaged over about ten seconds"
    )
    idle_seconds: float = Field(description="seconds since the session's last step")
    penalty: float = Field(
        description="number of predicted standard deviations that are subtracted from a reward (k of eq. 14)"
    )
    episodes: int = Field(description="number of episodes that have ended")
    returns: list[float] = Field(description="imagined returns of the last episodes that ended, oldest first")
    penalties: list[float] = Field(
        description="penalty for uncertainty that was subtracted from each return in ``returns``"
    )


class SessionList(Reply):
    """The open sessions of a surrogate, with their virtual steps and imagined returns."""

    sessions: list[SessionActivity] = Field(description="open sessions, oldest first")


class ResetSession(Request):
    """Request to begin new episodes in lanes of a session."""

    seq: Seq | None = Field(
        default=None,
        description="number of the request in its session: 1, 2, ...; null: the order of requests is not checked",
    )
    seed: Seed | Annotated[list[Seed], Field(max_length=MAX_LANES)] | None = Field(
        default=None,
        description="new seed of all lanes, or one seed for each lane; null: no new seed, so each lane begins its next "
        "episode",
    )
    mask: Annotated[list[bool], Field(max_length=MAX_LANES)] | None = Field(
        default=None, description="(N,) whether to reset each lane; null: reset all"
    )


class ResetReply(Reply):
    """First observations of the new episodes."""

    seq: int = Field(description="number of the request")
    observation: list[list[float]] = Field(
        description="(N, D) first observation of each lane that was reset, last observation of the others"
    )
    model_version: list[int] = Field(description="(N,) version of the model that each lane's episode runs under")


ActionRow = FiniteFloat | Annotated[list[FiniteFloat], Field(max_length=MAX_DIMENSIONS)]
Actions = Annotated[list[ActionRow], Field(min_length=1, max_length=MAX_LANES)]


class StepSession(Request):
    """Request to take one virtual step."""

    seq: Seq | None = Field(
        default=None, description="number of the request in its session: 1, 2, ...; null: the order is not checked"
    )
    action: Actions = Field(
        description="(N, F) action of F entries for each of N lanes; (N,) if an action is a single number"
    )
    mask: Annotated[list[bool], Field(max_length=MAX_LANES)] | None = Field(
        default=None,
        description="(N,) whether to step each lane; null: step all. The other lanes keep their state and get a reward "
        "of 0",
    )
    deviations: bool = Field(
        default=False, description="whether the reply has the predicted standard deviation of each output"
    )


class StepReply(Reply):
    """Result of a virtual step in each lane.

    With autoreset mode ``same_step``, a lane whose episode ended was reset in the same step. Its ``observation`` is
    then the first of the next episode, and ``final_observation`` is the last of the ended episode.
    """

    seq: int = Field(description="number of the request")
    observation: list[list[float]] = Field(description="(N, D) observation of D entries in each lane after the step")
    reward: list[float] = Field(description="(N,) rewards, less the penalty for uncertainty")
    terminated: list[bool] = Field(description="(N,) whether the episode ended in a terminal state")
    truncated: list[bool] = Field(
        description="(N,) whether the episode ended by the time limit, or where the model is too uncertain (``trust``)"
    )
    final_lanes: list[int] = Field(
        default_factory=list,
        description="(K,) numbers of the K lanes whose episode ended and that were reset within this step",
    )
    final_observation: list[list[float]] = Field(
        default_factory=list, description="(K, D) last observation of the ended episode in each lane of ``final_lanes``"
    )
    model_version: list[int] = Field(description="(N,) version of the model that each lane's episode runs under")
    reward_mean: list[float] = Field(description="(N,) rewards without the penalty for uncertainty")
    deviation: list[list[float]] | None = Field(
        default=None,
        description="(N, O) predicted standard deviation of each output; null if the request did not ask for it",
    )
    untrusted: list[bool] | None = Field(
        default=None,
        description="(N,) whether the episode was truncated because the model is too uncertain there (see ``trust``); "
        "null in a session without ``trust``",
    )
    left: list[bool] | None = Field(
        default=None,
        description="(N,) whether the episode ended outside of the sampling range, or where the fallback of declared "
        "limits acts; null if neither ``outside_reward`` nor ``limits`` is declared",
    )


Numbers = Annotated[list[FiniteFloat], Field(min_length=1, max_length=MAX_UNITS)]


class PolicyLayer(Request):
    """One layer of a network: x @ weights + bias."""

    weights: Annotated[list[Numbers], Field(min_length=1, max_length=MAX_UNITS)] = Field(
        description="(I, O) weights from I inputs to O outputs of the layer"
    )
    bias: Numbers = Field(description="(O,) bias of each output of the layer")


class PolicyArrays(Request):
    """Network that acts on standardised observations. The session's action space determines what its outputs mean.

    Continuous actions: the centre of the bounds plus half their width times tanh(outputs), plus noise, clipped to the
    bounds. Discrete actions: the outputs are scores of the choices of each entry. With noise, choices are drawn by
    softmax; without noise, the choice with the highest score is taken.
    """

    mean: Numbers = Field(description="(D,) mean that is subtracted from an observation")
    deviation: Numbers = Field(description="(D,) number by which an observation minus ``mean`` is divided")
    layers: Annotated[list[PolicyLayer], Field(min_length=1, max_length=MAX_LAYERS)] = Field(
        description="layers of the network, from the observation to the outputs"
    )
    activation: Activation = Field(default="tanh", description="activation function of the hidden layers")
    log_deviations: Numbers | None = Field(
        default=None,
        description="(F,) logarithm of the standard deviation of the noise of each continuous action entry; required "
        "for noise",
    )
    precision: Literal["float32", "float64"] = Field(
        default="float32", description="type of the numbers that the network computes with"
    )


class ActionNoise(Request):
    """Key of the random noise of actions. The same key, lane and action entry give the same random number."""

    seed: Seed = Field(description="seed of the noise")
    step: Seed = Field(
        default=0,
        description="number of the rollout's first step in the sequence of noise; each further step has the next "
        "number",
    )
    hold: Annotated[int, Field(ge=1, le=MAX_ROLLOUT)] = Field(
        default=1, description="number h of steps with the same noise: step numbers 0 to h - 1, h to 2 h - 1, and so on"
    )


class RolloutSession(Request):
    """Request to take several virtual steps: with given ``actions``, or with a ``policy`` for a number of ``steps``."""

    seq: Seq | None = Field(
        default=None, description="number of the request in its session: 1, 2, ...; null: the order is not checked"
    )
    actions: Annotated[list[Actions], Field(min_length=1, max_length=MAX_ROLLOUT)] | None = Field(
        default=None, description="(T, N, F) actions of F entries, for T steps of N lanes"
    )
    policy: PolicyArrays | None = Field(default=None, description="policy that acts in all lanes, on the server")
    steps: Annotated[int, Field(ge=1, le=MAX_ROLLOUT)] | None = Field(
        default=None,
        description="largest number of steps that the policy takes, T; ``until`` may end the rollout before",
    )
    noise: ActionNoise | None = Field(
        default=None,
        description="key of the noise that is added to the policy's actions; null: the most probable actions",
    )
    until: Annotated[list[bool], Field(max_length=MAX_LANES)] | None = Field(
        default=None,
        description="(N,) mask of lanes: the policy's rollout stops once an episode has ended in each masked lane; "
        "null: all ``steps`` are taken",
    )

    @model_validator(mode="after")
    def _actions_or_a_policy(self) -> Self:
        if (self.actions is None) == (self.policy is None):
            got = "neither" if self.actions is None else "both"
            raise ValueError(f"rollout: expected either actions or a policy, got {got}")
        if (self.policy is None) != (self.steps is None):
            came = "a policy without steps" if self.steps is None else "steps with actions"
            raise ValueError(f"rollout: expected steps with a policy, and no steps with actions, got {came}")
        if self.policy is None and (self.noise or self.until is not None):
            raise ValueError("rollout: expected 'noise' and 'until' only with a policy, got one of them with actions")
        return self


class RolloutReply(Reply):
    """Results of the steps of a rollout."""

    seq: int = Field(description="number of the request")
    steps: list[StepReply] = Field(description="result of each of T steps")
    action: list[list[list[float]]] | None = Field(
        default=None,
        description="(T, N, F) actions of the policy, before they are clipped to their bounds; null for given actions",
    )
    log_probability: list[list[float]] | None = Field(
        default=None, description="(T, N) log probability of each lane's action; null without noise"
    )


class SubmitOccupancy(Request):
    """Request to store the states that a session has visited."""

    checkpoint: Key = Field(
        description="name under which the states are stored, for requests of further queries near them"
    )


class SubmittedOccupancy(Reply):
    """Reply after the states that a session visited were stored."""

    checkpoint: str = Field(description="name under which the states are stored")
    states: int = Field(description="number of states that were stored")
    confidence_index: float | None = Field(
        default=None,
        description="how certain the session's model is at these states under random actions: the smallest confidence "
        "index of its outputs; null without a server",
    )
