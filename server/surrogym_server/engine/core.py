"""What a request makes of a session: pure, and the same in every engine and in ``LocalSurrogate``."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Protocol, assert_never

import numpy as np
import torch
from numpy.typing import NDArray

from surrogym_server.engine.requests import Advance, Open, Opening, PolicySteps, Reset, Rollout, SampledRewards, Step
from surrogym_server.engine.rollouts import parts_of, roll, roll_policy
from surrogym_server.engine.session import (
    Fingerprint,
    Outcome,
    Session,
    digest_of,
    open_session,
    reset_session,
    step_session,
)
from surrogym_server.environment.actions import policy_actions
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.errors import InvalidInput, NotReset, SurrogymError, TooLarge
from surrogym_server.models.guard import failure_of
from surrogym_server.models.port import DynamicsModel
from surrogym_server.virtual import VirtualSettings, in_fastest_form, reward_limits
from surrogym_shared.port import StepResult

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

SESSION_ID_BYTES = 16
MAX_PARTICLES = 4_000_000  # of all lanes of a session
MAX_PATHWISE_LANES = 4_096  # the function of each is some thousand numbers


class Models(Protocol):
    """Where the models of sessions come from; ``engine.models.ModelCache`` is one."""

    def get(self, surrogate: int, version: int, device: torch.device, /) -> DynamicsModel:
        """The model of a version, on a device."""

    def latest(self, surrogate: int, /) -> int:
        """The version that new episodes run under."""


def check_size(settings: VirtualSettings, max_lanes: int) -> None:
    """Raise ``TooLarge`` where a session has more lanes or particles than the limit."""
    if settings.num_envs > max_lanes:
        raise TooLarge(f"expected at most {max_lanes} lanes, got {settings.num_envs}")
    particles = settings.num_envs * settings.particles
    if settings.variant == "probabilistic" and particles > MAX_PARTICLES:
        raise TooLarge(f"expected at most {MAX_PARTICLES} particles in all lanes, got {particles}")
    if settings.variant == "pathwise" and settings.num_envs > MAX_PATHWISE_LANES:
        raise TooLarge(f"expected at most {MAX_PATHWISE_LANES} lanes of variant pathwise, got {settings.num_envs}")


def opened(
    request: Open, definition: EnvironmentDefinition, model: DynamicsModel, version: int, digest: str, place: str = ""
) -> Session:
    """A new session, stepped in the fastest form that its model has.

    Args:
        request: what was asked for.
        definition: of the surrogate, on the device where the lanes are to be.
        model: the version that the session begins with, on the same device.
        version: of the model.
        digest: of the opening.
        place: ending of the session's id.
    """
    opening = request.opening
    settings = _limited(resolved(opening, definition), request.rewards, model)
    return open_session(
        secrets.token_urlsafe(SESSION_ID_BYTES) + place,
        request.surrogate,
        definition,
        in_fastest_form(settings, model),
        seed=secrets.randbits(63) if opening.seed is None else opening.seed,
        model=opening.model,
        version=version,
        occupancy=opening.occupancy,
        opened_by=None if opening.key is None else (opening.key, digest),
        surrogate_id=request.surrogate_id,
    )


def resolved(opening: Opening, definition: EnvironmentDefinition) -> VirtualSettings:
    """Settings with what the trainer left to the surrogate."""
    return replace(
        opening.settings,
        time_limit=opening.settings.time_limit or definition.time_limit,
        penalty=definition.penalty if opening.penalty is None else opening.penalty,
    )


def limits_rewards(definition: EnvironmentDefinition) -> bool:
    """Whether the samples limit virtual rewards: not declared ones, which are exact, nor those of preset ``paper``."""
    return definition.declared_reward is None and definition.learning.limits_rewards


def _limited(settings: VirtualSettings, rewards: SampledRewards | None, model: DynamicsModel) -> VirtualSettings:
    """Settings with limits of rewards, unless an imported model has learned from more than these samples."""
    if rewards is None or not limits_rewards(model.definition) or model.samples > rewards.samples:
        return settings
    return replace(settings, reward_limits=reward_limits(rewards.low, rewards.high))


def fingerprint_of(request: Advance) -> Fingerprint:
    """What a repeat of the request has to equal, whatever carried it."""
    match request:
        case Step():
            return Fingerprint("step", _columns(request.action, 2), request.mask, request.deviations)
        case Reset():
            return Fingerprint("reset", request.seed, request.mask)
        case Rollout():
            return Fingerprint("rollout", _columns(request.actions, 3))
        case PolicySteps():  # at once: its parts would keep the policy
            return Fingerprint(digest=digest_of("policy", *parts_of(request.run)))
        case _:
            assert_never(request)


def steps_asked(request: Advance) -> int:
    """How many steps a request asks for at most; a reset counts for one."""
    match request:
        case Rollout():
            return len(request.actions)
        case PolicySteps():
            return request.run.steps
        case _:
            return 1


def carried_out(
    request: Advance, models: Models, wanted: Callable[[], None], interrupts: bool, session: Session
) -> tuple[Session, Outcome]:
    """The session after a request, and the outcome.

    Args:
        request: what to do.
        models: of the session's surrogate.
        wanted: asked before each step of a rollout; raises where nobody wants it any more.
        interrupts: whether ``KeyboardInterrupt`` in a model's code is a failure of that code: in a server, where a
            person's Ctrl-C comes in another way.
        session: as it is.

    Raises:
        InvalidInput: wrong shape, not finite, out of bounds.
        NotReset: a lane to step has not been reset.
        TooLarge: a rollout of too many steps in all lanes.
        PluginFailed: the code of the model's family failed.
    """
    if isinstance(request, Step):  # first, and by a call that costs less than a pattern: nearly all requests are steps
        u = policy_actions(session.definition.action, request.action, session.settings.num_envs)
        stepped, result = _stepped(session, u, request.mask, request.deviations, models, interrupts)
        return stepped, (result,)
    match request:
        case Reset():
            latest = models.latest(session.surrogate_id) if session.model == "latest" else session.model
            return reset_session(session, request.seed, request.mask, latest)
        case Rollout():
            return roll(session, request.actions, partial(_next_step, models, wanted, interrupts))
        case PolicySteps():
            return roll_policy(session, request.run, partial(_next_step, models, wanted, interrupts))
        case _:
            assert_never(request)


def visited_states(session: Session) -> Array:
    """The states that a session visited, (v, C).

    Raises:
        InvalidInput: it was opened without occupancy.
        NotReset: nothing was visited yet.
    """
    if session.visited is None:
        raise InvalidInput("expected a session opened with occupancy=true, got one without")
    if not len(session.visited.states):
        raise NotReset("expected a session that has visited states, got a new one: reset and step it first")
    return session.visited.states


def _next_step(
    models: Models, wanted: Callable[[], None], interrupts: bool, session: Session, u: Array
) -> tuple[Session, StepResult]:
    wanted()
    return _stepped(session, u, None, False, models, interrupts)


def _stepped(
    session: Session, u: Array, mask: Bools | None, deviations: bool, models: Models, interrupts: bool
) -> tuple[Session, StepResult]:
    surrogate, device = session.surrogate_id, session.definition.device
    latest = models.latest(surrogate) if session.model == "latest" else session.model
    try:
        return step_session(
            session, u, mask, deviations, lambda version: models.get(surrogate, version, device), latest
        )
    except SurrogymError:
        raise
    except BaseException as error:  # of a family's code; written out, as ``plugin_calls`` costs each step more
        if isinstance(error, KeyboardInterrupt) and not interrupts:
            raise
        raise failure_of(session.definition, error) from error


def _columns(action: Array, dimensions: int) -> Array:
    """Actions with their last axis, that some transports leave out where it has one entry; for the fingerprint."""
    return action[..., None] if action.ndim == dimensions - 1 else action
