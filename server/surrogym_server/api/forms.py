"""reset, step and rollout in their two forms, JSON and frames: the body of a request in, that of its reply out."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

import msgspec

from surrogym_server import convert
from surrogym_server.api.json_body import JSON, parse_as
from surrogym_server.engine.session import Answer, steps_of
from surrogym_server.services.sessions import SessionService
from surrogym_shared import frames
from surrogym_shared.wire import ResetSession, RolloutSession, StepSession

Carry = Callable[[SessionService, str, bytes], Awaitable[bytes]]

SHORT_ROLLOUT = 32  # steps; a longer one's reply takes milliseconds to write, and others don't wait for that

_JSON = msgspec.json.Encoder()


async def reset_json(sessions: SessionService, id: str, content: bytes) -> bytes:
    body = parse_as(ResetSession, content)
    answer = await sessions.reset(id, body.seq, body.seed, convert.lane_mask(body.mask))
    return _JSON.encode(convert.reset_reply(answer))


async def step_json(sessions: SessionService, id: str, content: bytes) -> bytes:
    body = parse_as(StepSession, content)
    action = convert.numbers("action", body.action)
    answer = await sessions.step(id, body.seq, action, convert.lane_mask(body.mask), body.deviations)
    return _JSON.encode(convert.step_reply(answer))


async def rollout_json(sessions: SessionService, id: str, content: bytes) -> bytes:
    body = parse_as(RolloutSession, content)
    if body.actions is None:
        answer = await sessions.rollout_policy(id, body.seq, convert.policy_run(body))
    else:
        answer = await sessions.rollout(id, body.seq, convert.numbers("actions", body.actions))
    return await _rollout_written(_rollout_in_json, answer)


async def carry_out(sessions: SessionService, id: str, shape: frames.Shape, request: frames.Request) -> bytes:
    """A frame's request, whatever carried it; raises ``FrameError`` where it does not fit the session's shape."""
    match request:
        case frames.StepRequest():
            action, mask = frames.action_of(request, shape), frames.mask_of(request, shape)
            answer = await sessions.step(id, request.seq, action, mask, request.deviations)
            return frames.encode(convert.step_frame(answer))
        case frames.ResetRequest():
            seed, mask = frames.seed_of(request, shape), frames.mask_of(request, shape)
            return frames.encode(convert.reset_frame(await sessions.reset(id, request.seq, seed, mask)))
        case frames.RolloutRequest():
            answer = await sessions.rollout(id, request.seq, frames.actions_of(request, shape))
            return await _rollout_written(_rollout_in_frames, answer)
        case frames.PolicyRequest():
            answer = await sessions.rollout_policy(id, request.seq, convert.framed_policy_run(request, shape))
            return await _rollout_written(_rollout_in_frames, answer)


async def _rollout_written(write: Callable[[Answer], bytes], answer: Answer) -> bytes:
    return write(answer) if steps_of(answer.outcome) <= SHORT_ROLLOUT else await asyncio.to_thread(write, answer)


def _rollout_in_json(answer: Answer) -> bytes:
    """Step by step: a thread that encodes lets no other one in."""
    steps = [msgspec.Raw(_JSON.encode(step)) for step in convert.rollout_steps(answer)]
    return _JSON.encode({"seq": answer.seq, "steps": steps, **convert.rollout_actions(answer)})


def _rollout_in_frames(answer: Answer) -> bytes:
    return frames.encode(convert.rollout_frame(answer))


def _framed(*kinds: type[frames.Request]) -> Carry:
    async def carry(sessions: SessionService, id: str, content: bytes) -> bytes:
        request = frames.read_request(content)
        if not isinstance(request, kinds):
            expected = " or a ".join(kind.__name__ for kind in kinds)
            raise frames.FrameError(f"expected a {expected}, got a {type(request).__name__}")
        return await carry_out(sessions, id, convert.session_shape(sessions.get(id)), request)

    return carry


RESET: dict[str, Carry] = {JSON: reset_json, frames.MEDIA_TYPE: _framed(frames.ResetRequest)}
STEP: dict[str, Carry] = {JSON: step_json, frames.MEDIA_TYPE: _framed(frames.StepRequest)}
ROLLOUT: dict[str, Carry] = {
    JSON: rollout_json,
    frames.MEDIA_TYPE: _framed(frames.RolloutRequest, frames.PolicyRequest),
}
