"""Conversion for sessions: requests to the engine's types, and the engine's answers to JSON replies and frames; and
conversion between arrays and nested lists."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_server.engine.requests import Array, Opening, Reply, SessionInfo
from surrogym_server.engine.tallies import SessionActivity
from surrogym_server.errors import InvalidInput
from surrogym_server.virtual import Residual, VirtualSettings
from surrogym_shared import frames
from surrogym_shared import wire as replies
from surrogym_shared.acting import ActingPolicy, NoiseKey, PolicyRun
from surrogym_shared.network import Layer
from surrogym_shared.port import PolicyRollout, ResetResult, StepResult
from surrogym_shared.spec import Action


def numbers(what: str, rows: Sequence[Any]) -> NDArray[np.float64]:
    """Convert nested lists of numbers to an array. ``what`` is their name in the error message.

    Raises:
        InvalidInput: the rows have different lengths.
    """
    try:
        return np.array(rows, dtype=np.float64)
    except (ValueError, TypeError) as error:
        raise InvalidInput(f"{what}: expected rows of equal length, got rows of different lengths") from error


def as_tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


CONVERTED = {"penalty", "sensor_noise", "set_points", "residual"}
# Options of a session that the core takes as they are sent.
SAME = {field.name for field in fields(VirtualSettings)} & replies.OpenSession.model_fields.keys() - CONVERTED


def opening(request: replies.OpenSession) -> Opening:
    settings = VirtualSettings(
        **{name: getattr(request, name) for name in SAME},
        penalty=request.penalty or 0.0,
        sensor_noise=tuple(sorted(request.sensor_noise.items())),
        set_points=tuple(sorted(request.set_points.items())),
        residual=None if request.residual is None else residual(request.residual),
    )
    return Opening(
        settings=settings,
        penalty=request.penalty,
        seed=request.seed,
        model=request.model,
        occupancy=request.occupancy,
        key=request.idempotency_key,
    )


def residual(given: replies.Residual) -> Residual:
    weights = tuple(tuple(map(tuple, rows)) for rows in given.weights)
    return Residual(tuple(given.centre), tuple(given.scale), weights)


def session_view(session: SessionInfo, idle_seconds: float, replay: int = 0) -> replies.SessionView:
    return replies.SessionView(
        id=session.id,
        surrogate=session.surrogate,
        num_envs=session.settings.num_envs,
        variant=session.settings.variant,
        seed=session.seed,
        autoreset_mode=session.settings.autoreset_mode,
        model=session.model,
        model_version=session.versions.tolist(),
        seq=session.seq,
        time_limit=session.settings.time_limit,
        penalty=session.settings.penalty,
        observation_space=_box((o.low, o.high) for o in session.definition.observation),
        action_space=_action_space(session.definition.action),
        outputs=list(session.definition.outputs),
        idle_seconds=idle_seconds,
        replay=replay,
    )


def session_coordinates(coordinates: Array) -> replies.SessionCoordinates:
    """Return the reply that holds the coordinates (N, C) of a session's lanes."""
    return replies.SessionCoordinates(coordinates=coordinates.tolist())


def session_activity(activity: SessionActivity) -> replies.SessionActivity:
    session = activity.session
    return replies.SessionActivity(
        id=session.id,
        num_envs=session.settings.num_envs,
        variant=session.settings.variant,
        model=session.model,
        model_version=sorted(set(session.versions.tolist())),
        steps=activity.steps,
        steps_per_second=activity.steps_per_second,
        idle_seconds=activity.idle_seconds,
        penalty=session.settings.penalty,
        episodes=activity.episodes,
        returns=[episode.reward for episode in activity.recent],
        penalties=[episode.penalty for episode in activity.recent],
    )


def _box(ranges: Iterable[tuple[float | None, float | None]]) -> replies.BoxSpace:
    low, high = zip(*ranges, strict=True)
    return replies.BoxSpace(low=list(low), high=list(high))


def _action_space(action: Action) -> replies.ActionSpace:
    match action.policy_counts:
        case ():
            return _box(action.ranges)
        case (n,) if action.kind != "multi_discrete":
            return replies.DiscreteSpace(n=n)
        case counts:
            return replies.MultiDiscreteSpace(nvec=list(counts))


def lane_mask(mask: list[bool] | None) -> NDArray[np.bool_] | None:
    return None if mask is None else np.array(mask, dtype=bool)


def reset_reply(reply: Reply) -> dict[str, Any]:
    """Return the fields of the JSON reply to a reset of a session. No pydantic model validates them, to save time."""
    assert isinstance(reply.outcome, ResetResult)
    result = reply.outcome
    return {
        "seq": reply.seq,
        "observation": result.observation.tolist(),
        "model_version": result.model_version.tolist(),
    }


def step_reply(reply: Reply) -> dict[str, Any]:
    """Return the fields of the JSON reply to a step of a session. No pydantic model validates them, to save time."""
    assert isinstance(reply.outcome, tuple)
    return _step_fields(reply.seq, reply.outcome[0])


def rollout_steps(reply: Reply) -> Iterator[dict[str, Any]]:
    """Yield the JSON fields of each step of a rollout, for the reply. All have the sequence number of the request."""
    assert not isinstance(reply.outcome, ResetResult)
    steps = reply.outcome.steps() if isinstance(reply.outcome, PolicyRollout) else reply.outcome
    return (_step_fields(reply.seq, step) for step in steps)


def rollout_actions(reply: Reply) -> dict[str, Any]:
    """Return the JSON fields with the actions, and their log probabilities, that a policy chose in a rollout. Return an
    empty dictionary if the caller gave the actions."""
    if not isinstance(reply.outcome, PolicyRollout):
        return {}
    log = reply.outcome.log_probability
    return {"action": reply.outcome.action.tolist()} | ({} if log is None else {"log_probability": log.tolist()})


def policy_run(request: replies.RolloutSession) -> PolicyRun:
    """Read the policy and its settings from a JSON request for a rollout. Raises ``InvalidInput`` if the shapes of the
    policy's arrays contradict each other."""
    assert request.policy is not None
    assert request.steps is not None
    given, dtype = request.policy, np.dtype(request.policy.precision)

    def array(name: str, rows: Any) -> NDArray[Any]:
        # No warning of NumPy: a value too large for float32 becomes infinite here, and is refused later.
        with np.errstate(over="ignore"):
            return numbers(name, rows).astype(dtype)

    try:
        policy = ActingPolicy(
            array("mean", given.mean),
            array("deviation", given.deviation),
            tuple(Layer(array("weights", layer.weights), array("bias", layer.bias)) for layer in given.layers),
            given.activation,
            None if given.log_deviations is None else array("log_deviations", given.log_deviations),
        )
    except ValueError as error:
        raise InvalidInput(str(error)) from error
    noise = None if request.noise is None else NoiseKey(request.noise.seed, request.noise.step, request.noise.hold)
    return PolicyRun(policy, request.steps, noise, lane_mask(request.until))


def framed_policy_run(request: frames.PolicyRequest, shape: frames.Shape) -> PolicyRun:
    """Read the policy and its settings from a binary request for a rollout. ``shape`` has the sizes of the session's
    arrays. Raises ``FrameError`` if the request does not fit these sizes."""
    policy, until = frames.policy_of(request, shape), frames.until_of(request, shape)
    return PolicyRun(policy, request.steps, frames.noise_of(request), until)


def session_shape(session: SessionInfo) -> frames.Shape:
    """Return the sizes of a session's arrays, which its frames don't contain."""
    definition = session.definition
    return frames.Shape(
        lanes=session.settings.num_envs,
        observation=len(definition.observation_names),
        action=definition.action.size,
        outputs=len(definition.outputs),
    )


def reset_frame(reply: Reply) -> frames.ResetReply:
    assert isinstance(reply.outcome, ResetResult)
    return frames.reset_reply(reply.seq, reply.outcome)


def step_frame(reply: Reply) -> frames.StepReply:
    assert isinstance(reply.outcome, tuple)
    return frames.step_reply(reply.seq, reply.outcome[0])


def rollout_frame(reply: Reply) -> frames.RolloutReply | frames.PolicyReply:
    assert not isinstance(reply.outcome, ResetResult)
    if isinstance(reply.outcome, PolicyRollout):
        return frames.policy_reply(reply.seq, reply.outcome)
    return frames.rollout_reply(reply.seq, reply.outcome)


def _step_fields(seq: int, step: StepResult) -> dict[str, Any]:
    arrays = {field.name: getattr(step, field.name) for field in fields(StepResult)}
    lists = {name: None if array is None else array.tolist() for name, array in arrays.items()}
    return {"seq": seq, **lists}
