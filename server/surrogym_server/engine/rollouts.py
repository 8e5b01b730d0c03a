"""Rollouts: several steps of one session in one request, with given actions or with those of a policy.

Shapes: N lanes, D observation entries, F action entries, T steps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from surrogym_server.engine.session import Session
from surrogym_server.environment.actions import policy_actions
from surrogym_server.environment.definition import ActionDefinition
from surrogym_server.errors import InvalidInput, TooLarge
from surrogym_server.virtual.sensors import sensed
from surrogym_shared.acting import Acted, Actor, NoiseKey, PolicyRun
from surrogym_shared.policy_sizes import MAX_ACTIVATIONS, MAX_LANE_STEPS
from surrogym_shared.port import PolicyRollout, StepResult

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
# A function that takes one step of a session under the actions (N, F) of N lanes, encoded for the model. It returns the
# new session and the result of the step.
OneStep = Callable[[Session, Floats], tuple[Session, StepResult]]


def parts_of(run: PolicyRun) -> tuple[object, ...]:
    """Return all values that determine a policy's rollout, from which the content hash of its request is computed."""
    policy = run.policy
    arrays = (policy.mean, policy.deviation, policy.vector, policy.log_deviations, run.until)
    return (run.steps, policy.units, policy.activation, run.noise, *arrays)


def roll(session: Session, actions: NDArray[np.float64], step: OneStep) -> tuple[Session, tuple[StepResult, ...]]:
    """Take T steps of a session of N lanes with actions (T, N, F), or (T, N) if F = 1. Return the new session and the
    result of each step.

    ``step`` takes one step. All actions are checked before the first step. If an error is raised, no step counts.

    Raises:
        InvalidInput: actions have a wrong shape, are not finite, or are out of bounds.
        TooLarge: the number of steps times lanes is too large.
    """
    lanes, results = session.settings.num_envs, []
    _check_steps(len(actions), lanes)
    for u in [policy_actions(session.definition.action, row, lanes) for row in actions]:
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
    actor = _actor(len(definition.observation_names), definition.action, run)
    waiting = _lanes_without_an_end(run, lanes)
    sensed_states = sensed(definition, session.settings.sensor_noise, session.lanes)
    observation = definition.observe(sensed_states).to(torch.float32).cpu().numpy()
    results, actions, logs = [], [], []
    for number in range(run.steps):
        acted = _act(actor, observation, None if run.noise is None else run.noise.later(number))
        session, result = step(session, policy_actions(definition.action, acted.sent, lanes))
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


def _actor(observation: int, action: ActionDefinition, run: PolicyRun) -> Actor:
    low, high = action.limits
    try:
        return Actor(run.policy, observation, low, high, action.policy_counts, noisy=run.noise is not None)
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


def _stacked(rows: Iterable[NDArray[Any] | None]) -> Floats:
    return np.stack([row for row in rows if row is not None]).astype(np.float64)
