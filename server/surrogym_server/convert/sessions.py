"""Sessions: requests to openings, answers to replies and frames."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_server.engine.session import Answer, Session
from surrogym_server.environment import definition as core
from surrogym_server.services.activity import SessionActivity
from surrogym_server.services.sessions import Opening
from surrogym_server.virtual import VirtualSettings
from surrogym_shared import frames
from surrogym_shared import wire as replies
from surrogym_shared.port import ResetResult, StepResult


def opening(request: replies.OpenSession) -> Opening:
    settings = VirtualSettings(
        num_envs=request.num_envs,
        variant=request.variant,
        autoreset_mode=request.autoreset_mode,
        time_limit=request.time_limit,
        penalty=request.penalty or 0.0,
        start_box=request.start_box,
        process_noise=request.process_noise,
        trust=request.trust,
        particles=request.particles,
        propagation=request.propagation,
        weighting=request.weighting,
        spread=request.spread,
        functions=request.functions,
    )
    return Opening(
        settings=settings,
        penalty=request.penalty,
        seed=request.seed,
        model=request.model,
        occupancy=request.occupancy,
        key=request.idempotency_key,
    )


def session_view(session: Session, idle_seconds: float) -> replies.SessionView:
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
        observation_space=_box(session.definition.observation_low, session.definition.observation_high),
        action_space=_action_space(session.definition.action),
        outputs=list(session.definition.outputs),
        idle_seconds=idle_seconds,
    )


def session_coordinates(session: Session) -> replies.SessionCoordinates:
    return replies.SessionCoordinates(coordinates=session.lanes.q.tolist())


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


def _box(low: Iterable[float], high: Iterable[float]) -> replies.BoxSpace:
    return replies.BoxSpace(
        low=[x if math.isfinite(x) else None for x in low], high=[x if math.isfinite(x) else None for x in high]
    )


def _action_space(action: core.ActionDefinition) -> replies.ActionSpace:
    match action.policy_counts:
        case ():
            return _box(action.low, action.high)
        case (n,) if action.kind != "multi_discrete":
            return replies.DiscreteSpace(n=n)
        case counts:
            return replies.MultiDiscreteSpace(nvec=list(counts))


def lane_mask(mask: list[bool] | None) -> NDArray[np.bool_] | None:
    return None if mask is None else np.array(mask, dtype=bool)


def reset_reply(answer: Answer) -> dict[str, Any]:
    """The fields of ``ResetReply``, unchecked: this and ``step_reply`` are on the path of every step."""
    assert isinstance(answer.outcome, ResetResult)
    result = answer.outcome
    return {
        "seq": answer.seq,
        "observation": result.observation.tolist(),
        "model_version": result.model_version.tolist(),
    }


def step_reply(answer: Answer) -> dict[str, Any]:
    """The fields of ``StepReply``."""
    assert isinstance(answer.outcome, tuple)
    return _step_fields(answer.seq, answer.outcome[0])


def rollout_steps(answer: Answer) -> Iterator[dict[str, Any]]:
    """The fields of the steps of ``RolloutReply``, one by one; they all carry the one seq of the request."""
    assert isinstance(answer.outcome, tuple)
    return (_step_fields(answer.seq, step) for step in answer.outcome)


def session_shape(session: Session) -> frames.Shape:
    """What a session's frames leave out."""
    definition = session.definition
    return frames.Shape(
        lanes=session.settings.num_envs,
        observation=len(definition.observation_names),
        action=definition.action.size,
        outputs=len(definition.outputs),
    )


def reset_frame(answer: Answer) -> frames.ResetReply:
    assert isinstance(answer.outcome, ResetResult)
    return frames.reset_reply(answer.seq, answer.outcome)


def step_frame(answer: Answer) -> frames.StepReply:
    assert isinstance(answer.outcome, tuple)
    return frames.step_reply(answer.seq, answer.outcome[0])


def rollout_frame(answer: Answer) -> frames.RolloutReply:
    assert isinstance(answer.outcome, tuple)
    return frames.rollout_reply(answer.seq, answer.outcome)


def _step_fields(seq: int, step: StepResult) -> dict[str, Any]:
    arrays = {field.name: getattr(step, field.name) for field in fields(StepResult)}
    lists = {name: None if array is None else array.tolist() for name, array in arrays.items()}
    return {"seq": seq, **lists}
