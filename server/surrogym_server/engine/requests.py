"""Requests and replies of a session engine, and the pure functions that apply requests to sessions.

The requests and replies are frozen dataclasses that can be pickled. Every engine and ``LocalSurrogate`` call the
functions. A rollout is several steps of one session in one request, with given actions or with those of a policy.

Shapes: N lanes, C coordinates, D observation entries, F action entries, T steps.
"""

from __future__ import annotations

import secrets
from bisect import bisect_right
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Protocol, assert_never

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from surrogym_server.engine.session import (
    Fingerprint,
    Outcome,
    Reservoir,
    Seeds,
    Session,
    Versions,
    WantedVersion,
    digest_of,
    reset_session,
    step_session,
)
from surrogym_server.environment.actions import policy_actions
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.errors import InvalidInput, NotReset, SurrogymError, TooLarge
from surrogym_server.models.guard import failure_of
from surrogym_server.models.port import DynamicsModel, with_set_points
from surrogym_server.tensors import free_bytes
from surrogym_server.virtual import VirtualSettings, create, expected_gpu_bytes, in_fastest_form, reward_limits
from surrogym_server.virtual.sensors import check as check_sensors
from surrogym_server.virtual.sensors import sensed
from surrogym_shared.acting import Acted, Actor, NoiseKey, PolicyRun
from surrogym_shared.policy_sizes import MAX_ACTIVATIONS, MAX_LANE_STEPS
from surrogym_shared.port import PolicyRollout, StepResult

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Opening:
    """Settings with which a caller opens a session.

    A time limit or penalty of None means that of the surrogate's specification, a seed of None a random seed.
    """

    settings: VirtualSettings
    penalty: float | None
    seed: int | None
    model: WantedVersion
    occupancy: bool
    key: str | None


@dataclass(frozen=True)
class SampledRewards:
    """Lowest and highest reward in a surrogate's samples, and the number of the samples.

    Rewards of virtual steps are limited to this range, widened by ``virtual.limits.reward_limits``.
    """

    low: float
    high: float
    samples: int


@dataclass(frozen=True)
class Open:
    """Request to open a session of a stored surrogate."""

    surrogate: str
    surrogate_id: int
    definition: EnvironmentDefinition
    opening: Opening
    rewards: SampledRewards | None = None  # range of the samples' rewards, which limits virtual ones; None: no limits
    visited: Array | None = None  # (k, C) coordinates of k real steps, at which the session may start episodes


@dataclass(frozen=True, eq=False)
class Reset:
    """Request to begin new episodes in the lanes that ``mask`` selects, or in all lanes of a session."""

    session: str
    seq: int | None  # the session's next sequence number; None: the engine can't recognise a repeat of the request
    seed: Seeds = None
    mask: Bools | None = None  # (N,) which of the N lanes the request resets or steps; None: all
    within: float | None = None  # the caller waits at most this many seconds for the reply; None: no limit


@dataclass(frozen=True, eq=False)
class Step:
    """Request for one step in the lanes that ``mask`` selects, or in all lanes of a session."""

    session: str
    seq: int | None
    action: Array  # (N, F) a policy's action of F entries for each of N lanes; also (N,) if F = 1
    mask: Bools | None = None  # (N,) which of the N lanes the request resets or steps; None: all
    stds: bool = False
    within: float | None = None


@dataclass(frozen=True, eq=False)
class Rollout:
    """Request for T steps of all lanes of a session with given actions. If a step fails, none counts as taken."""

    session: str
    seq: int | None
    actions: Array  # (T, N, F) a policy's actions for each of T steps and N lanes; also (T, N) if F = 1
    within: float | None = None


@dataclass(frozen=True, eq=False)
class PolicySteps:
    """Request for steps of all lanes of a session with actions that a policy chooses. If a step fails, none counts as
    taken."""

    session: str
    seq: int | None
    run: PolicyRun
    within: float | None = None


Advance = Reset | Step | Rollout | PolicySteps


@dataclass(frozen=True, eq=False)
class Reply:
    """Answer to a reset, step or rollout. A repeat of the request gets the same answer."""

    seq: int
    outcome: Outcome


@dataclass(frozen=True, eq=False)
class SessionInfo:
    """Description of a session: its surrogate, its settings, and the versions of its models."""

    id: str
    surrogate: str
    surrogate_id: int
    definition: EnvironmentDefinition = field(repr=False)
    settings: VirtualSettings
    seed: int
    model: WantedVersion
    versions: Versions  # (N,) version of the model that computes the current episode of each lane
    seq: int  # sequence number of the last request that the session has answered; 0 before the first
    # Whether the session was restored from an older checkpoint, so that the client has to repeat its last requests.
    behind: bool = False


@dataclass(frozen=True, eq=False)
class Visited:
    """States that a session visited, and the model's confidence index over them."""

    surrogate_id: int
    states: Array  # (v, C) coordinates of v visited states, a random sample if there were too many
    confidence_index: float


@dataclass(frozen=True)
class Saved:
    """A saved session as bytes, without the environment's definition, which is stored with the surrogate."""

    id: str
    surrogate: str
    data: bytes = field(repr=False)


@dataclass(frozen=True)
class Restore:
    """Request to restore a saved session.

    ``surrogate_id`` and ``definition`` are those of the surrogate that now has the name in ``saved``.
    """

    saved: Saved
    surrogate_id: int
    definition: EnvironmentDefinition = field(repr=False)


def info_of(session: Session) -> SessionInfo:
    return SessionInfo(
        id=session.id,
        surrogate=session.surrogate,
        surrogate_id=session.surrogate_id,
        definition=session.definition,
        settings=session.settings,
        seed=session.seed,
        model=session.model,
        versions=session.versions,
        seq=session.seq,
    )


SESSION_ID_BYTES = 16
MAX_PARTICLES = 4_000_000  # a session of variant probabilistic may have at most this many particles in all its lanes


class Models(Protocol):
    """Source of models for sessions. ``engine.models.ModelCache`` implements it."""

    def get(self, surrogate: int, version: int, device: torch.device, /) -> DynamicsModel:
        """Return version ``version`` of a surrogate's model, with its tensors on ``device``."""

    def latest(self, surrogate: int, /) -> int:
        """Return the newest version of a surrogate's model, with which new episodes start."""


def check_size(settings: VirtualSettings, max_lanes: int) -> None:
    """Raise ``TooLarge`` if a session would have more than ``max_lanes`` lanes or too many particles."""
    if settings.num_envs > max_lanes:
        raise TooLarge(f"expected a session of at most {max_lanes} lanes, got {settings.num_envs}: open fewer lanes")
    particles = settings.num_envs * settings.particles
    if settings.variant == "probabilistic" and particles > MAX_PARTICLES:
        raise TooLarge(
            f"expected at most {MAX_PARTICLES} particles in all lanes of a session, got {particles}: open fewer lanes "
            "or choose fewer particles"
        )


def check_gpu(
    device: torch.device, definition: EnvironmentDefinition, settings: VirtualSettings, path_size: int, samples: int
) -> None:
    """Check that a session of a model of ``samples`` samples fits in the free memory of its GPU, before it takes any.

    Raises:
        TooLarge: it does not; the message has the number of lanes that fits.
    """
    if (free := free_bytes(device)) is None:
        return

    def needed(lanes: int) -> int:
        return expected_gpu_bytes(definition, replace(settings, num_envs=lanes), path_size, samples)

    if (nbytes := needed(settings.num_envs)) > free:
        most = bisect_right(range(1, settings.num_envs + 1), free, key=needed)
        raise TooLarge(
            f"expected a session that fits in the free memory of the GPU, {free / 2**20:,.0f} MiB, got one of "
            f"{settings.num_envs} lanes, whose steps take about {nbytes / 2**20:,.0f} MiB: "
            + (f"open at most {most} lanes" if most else "close other sessions, or start the server with --device cpu")
        )


def opened(
    request: Open, definition: EnvironmentDefinition, model: DynamicsModel, version: int, digest: str, place: str = ""
) -> Session:
    """Return a new session, which uses the fastest implementation of steps that its model has.

    Args:
        request: request to open the session.
        definition: definition of the environment, on the device of the session.
        model: the model that the session begins with, on the same device.
        version: version of this model.
        digest: content hash of the request, to recognise a repeat.
        place: suffix of the session's id, which names the process that runs the session.

    Raises:
        InvalidInput: an option does not fit the environment or the model.
    """
    opening = request.opening
    with_set_points(model, opening.settings.set_points)  # raises an error if they don't fit
    settings = _limited(resolved(opening, definition), request.rewards, model)
    settings = replace(settings, visited=_starts(settings, definition, request.visited))
    settings = in_fastest_form(settings, model)
    seed = secrets.randbits(63) if opening.seed is None else opening.seed
    return Session(
        id=secrets.token_urlsafe(SESSION_ID_BYTES) + place,
        surrogate=request.surrogate,
        definition=definition,
        settings=settings,
        seed=seed,
        model=opening.model,
        lanes=create(definition, settings, seed),
        versions=np.full(settings.num_envs, version, dtype=np.int64),
        visited=Reservoir(seed) if opening.occupancy else None,
        opened_by=None if opening.key is None else (opening.key, digest),
        surrogate_id=request.surrogate_id,
    )


def resolved(opening: Opening, definition: EnvironmentDefinition) -> VirtualSettings:
    """Return the settings with which a session is opened. A time limit or penalty that ``opening`` does not give is
    that of the surrogate's environment definition.

    Raises:
        InvalidInput: the sensor noise names an unknown coordinate, or the residual does not fit the environment.
    """
    check_sensors(definition, opening.settings.sensor_noise)
    if opening.settings.residual is not None:
        opening.settings.residual.check(definition)
    return replace(
        opening.settings,
        time_limit=opening.settings.time_limit or definition.time_limit,
        penalty=definition.penalty if opening.penalty is None else opening.penalty,
    )


def limits_rewards(definition: EnvironmentDefinition) -> bool:
    """Whether rewards of virtual steps are limited to about the range of the samples' rewards.

    They are not limited in preset ``paper``, or if the specification declares the reward function, because such rewards
    are exact.
    """
    return definition.declared_reward is None and definition.learning.limits_rewards


def _limited(settings: VirtualSettings, rewards: SampledRewards | None, model: DynamicsModel) -> VirtualSettings:
    """Add limits of virtual rewards to the settings of a session, from the range of the samples' rewards.

    No limits are added if there are no samples (``rewards`` is None), if the specification declares the reward or has
    the preset ``paper``, or if the model has learned from more samples than are stored, as an imported model may have.
    """
    if rewards is None or not limits_rewards(model.definition) or model.samples > rewards.samples:
        return settings
    return replace(settings, reward_limits=reward_limits(rewards.low, rewards.high))


def _starts(settings: VirtualSettings, definition: EnvironmentDefinition, states: Array | None) -> Tensor | None:
    """Return ``states`` (k, C), those of k real steps, as a tensor if the setting ``start_visited`` is above 0: then
    this share of the episodes starts at one of them. Return None if the setting is 0.

    Raises:
        InvalidInput: the setting is above 0, and the surrogate has no real steps.
    """
    if settings.start_visited == 0:
        return None
    if states is None or not len(states):
        raise InvalidInput(
            "start_visited: expected a surrogate with stored real steps, got one without, such as one from a file: set "
            "start_visited to 0"
        )
    return torch.tensor(states, dtype=torch.float64, device=definition.device)


def fingerprint_of(request: Advance) -> Fingerprint:
    """Return the content hash of a request, by which a repeat is recognised. It does not depend on the transport."""
    match request:
        case Step():
            return Fingerprint("step", _columns(request.action, 2), request.mask, request.stds)
        case Reset():
            return Fingerprint("reset", request.seed, request.mask)
        case Rollout():
            return Fingerprint("rollout", _columns(request.actions, 3))
        case PolicySteps():
            # The hash is computed at once. A hash on first use would keep the policy's weights in memory until then.
            return Fingerprint(digest=digest_of("policy", *parts_of(request.run)))
        case _:
            assert_never(request)


def steps_asked(request: Advance) -> int:
    """Return how many steps of a session a request takes at most; a reset counts as one step. A policy's rollout may
    take fewer."""
    match request:
        case Rollout():
            return len(request.actions)
        case PolicySteps():
            return request.run.steps
        case _:
            return 1


def carried_out(
    request: Advance, models: Models, require_wanted: Callable[[], None], interrupts: bool, session: Session
) -> tuple[Session, Outcome]:
    """Apply a reset, step or rollout to a session. Returns the new session and the outcome.

    Args:
        request: the reset, step or rollout.
        models: source of the models.
        require_wanted: called before each step of a rollout; raises if the session was closed or the server stops.
        interrupts: whether a ``KeyboardInterrupt`` from a model's code counts as a failure of that code. True in a
            server, where Ctrl-C does not raise it.
        session: the session before the request.

    Raises:
        InvalidInput: actions have a wrong shape, are not finite, or are out of bounds.
        NotReset: a lane to step has not been reset.
        TooLarge: the rollout has too many steps times lanes.
        PluginFailed: the code of the model's family raised an error.
    """
    if isinstance(request, Step):  # handled first, without pattern matching, because most requests are steps
        u = policy_actions(session.definition, request.action, session.settings.num_envs)
        after, result = _step(session, u, request.mask, request.stds, models, interrupts)
        return after, (result,)
    match request:
        case Reset():
            latest = models.latest(session.surrogate_id) if session.model == "latest" else session.model
            return reset_session(session, request.seed, request.mask, latest)
        case Rollout():
            return roll(session, request.actions, partial(_next_step, models, require_wanted, interrupts))
        case PolicySteps():
            return roll_policy(session, request.run, partial(_next_step, models, require_wanted, interrupts))
        case _:
            assert_never(request)


def visited_states(session: Session) -> Array:
    """Return the states (v, C) that a session visited.

    Raises:
        InvalidInput: the session was opened without the option ``occupancy``, which records visited states.
        NotReset: the session has visited no state yet.
    """
    if session.visited is None:
        raise InvalidInput(
            "expected a session opened with occupancy=true, which records visited states, got one without: open a new "
            "session"
        )
    if not len(session.visited.states):
        raise NotReset("expected a session that has visited states, got a new one: reset and step it first")
    return session.visited.states


def _next_step(
    models: Models, require_wanted: Callable[[], None], interrupts: bool, session: Session, u: Array
) -> tuple[Session, StepResult]:
    require_wanted()
    return _step(session, u, None, False, models, interrupts)


def _step(
    session: Session, u: Array, mask: Bools | None, stds: bool, models: Models, interrupts: bool
) -> tuple[Session, StepResult]:
    surrogate, device = session.surrogate_id, session.definition.device
    latest = models.latest(surrogate) if session.model == "latest" else session.model
    points = session.settings.set_points
    try:
        return step_session(
            session,
            u,
            mask,
            stds,
            lambda version: with_set_points(models.get(surrogate, version, device), points),
            latest,
        )
    except SurrogymError:
        raise
    except BaseException as error:
        # A model family, perhaps of a plug-in, raised this error. ``plugin_calls`` would convert it too, but a context
        # manager would slow each step.
        if isinstance(error, KeyboardInterrupt) and not interrupts:
            raise
        raise failure_of(session.definition, error) from error


def _columns(action: Array, dimensions: int) -> Array:
    """Return an array of actions with ``dimensions`` axes: a last axis of length 1 is added if there is one axis less.

    Some transports omit the last axis if an action has one entry. The hash of a request must not depend on that.
    """
    return action[..., None] if action.ndim == dimensions - 1 else action


# A function that takes one step of a session under the actions (N, F) of N lanes, encoded for the model. It returns the
# new session and the result of the step.
OneStep = Callable[[Session, Array], tuple[Session, StepResult]]


def parts_of(run: PolicyRun) -> tuple[object, ...]:
    """Return all values that determine a policy's rollout, from which the content hash of its request is computed."""
    policy = run.policy
    arrays = (policy.mean, policy.deviation, policy.vector, policy.log_deviations, run.until)
    return (run.steps, policy.units, policy.activation, run.noise, *arrays)


def roll(session: Session, actions: Array, step: OneStep) -> tuple[Session, tuple[StepResult, ...]]:
    """Take T steps of a session of N lanes with actions (T, N, F), or (T, N) if F = 1. Return the new session and the
    result of each step.

    ``step`` takes one step. All actions are checked before the first step. If an error is raised, no step counts.

    Raises:
        InvalidInput: actions have a wrong shape, are not finite, or are out of bounds.
        TooLarge: the number of steps times lanes is too large.
    """
    lanes, results = session.settings.num_envs, []
    _check_steps(len(actions), lanes)
    for u in [policy_actions(session.definition, row, lanes) for row in actions]:
        session, result = step(session, u)
        results.append(result)
    return session, tuple(results)


def roll_policy(session: Session, run: PolicyRun, step: OneStep) -> tuple[Session, PolicyRollout]:
    """Take steps of a session with the actions of a policy. ``step`` takes one step. If an error is raised, no step
    counts. If ``run.until`` is given, stop as soon as each lane that it selects has ended an episode.

    Raises:
        InvalidInput: the policy's observation or action size differs from the session's, ``run.until`` does not have
            one entry for each lane, or actions are not finite.
        TooLarge: the number of steps times lanes, or of a layer's units times lanes, is too large.
    """
    definition, lanes = session.definition, session.settings.num_envs
    _check_steps(run.steps, lanes)
    if lanes * max(run.policy.units) > MAX_ACTIVATIONS:
        raise TooLarge(
            f"expected units of the policy's widest layer times lanes to be at most {MAX_ACTIVATIONS}, got "
            f"{max(run.policy.units)} x {lanes}: open fewer lanes, or take a smaller policy"
        )
    actor = _actor(definition, run)
    waiting = _lanes_without_an_end(run, lanes)
    sensed_states = sensed(definition, session.settings.sensor_noise, session.lanes)
    observation = definition.observe(sensed_states).to(torch.float32).cpu().numpy()
    results, actions, logs = [], [], []
    for number in range(run.steps):
        acted = _act(actor, observation, None if run.noise is None else run.noise.later(number))
        session, result = step(session, policy_actions(definition, acted.sent, lanes))
        results.append(result)
        actions.append(acted.action)
        logs.append(acted.log_probability)
        observation = result.observation
        waiting &= ~(result.terminated | result.truncated)
        if run.until is not None and not waiting.any():
            break
    return session, PolicyRollout.of(results, _stacked(actions), None if run.noise is None else _stacked(logs))


def _check_steps(steps: int, lanes: int) -> None:
    if steps * lanes > MAX_LANE_STEPS:
        raise TooLarge(
            f"expected steps times lanes in one request to be at most {MAX_LANE_STEPS}, got {steps} x {lanes}: take "
            "fewer steps"
        )


def _actor(definition: EnvironmentDefinition, run: PolicyRun) -> Actor:
    (low, high), counts = definition.action_limits, definition.action.policy_counts
    try:
        return Actor(run.policy, len(definition.observation), low, high, counts, noisy=run.noise is not None)
    except ValueError as error:
        raise InvalidInput(str(error)) from error


def _lanes_without_an_end(run: PolicyRun, lanes: int) -> Bools:
    if run.until is None:
        return np.ones(lanes, dtype=bool)
    if run.until.shape != (lanes,):
        raise InvalidInput(f"until: expected {lanes} entries, one for each lane, got {len(run.until)}")
    return run.until.copy()


def _act(actor: Actor, observation: NDArray[np.float32], noise: NoiseKey | None) -> Acted:
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            return actor.act(observation, noise)
    except ValueError as error:
        raise InvalidInput(str(error)) from error


def _stacked(rows: Iterable[NDArray[Any] | None]) -> Array:
    return np.stack([row for row in rows if row is not None]).astype(np.float64)
