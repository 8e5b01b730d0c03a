"""Reading and writing of the requests reset, step and rollout in their two forms, JSON and binary frames.

The header ``x-deadline-ms`` says how long a caller waits for a reply. If the reply would come later, the step is not
computed.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from typing import Any, Literal

import msgspec

from surrogym_server.api.door import parse_as
from surrogym_server.api.problems import shown
from surrogym_server.convert import sessions
from surrogym_server.convert.sessions import numbers
from surrogym_server.engine.port import SessionEngine
from surrogym_server.engine.requests import Advance, PolicySteps, Reply, Reset, Rollout, Step
from surrogym_server.engine.session import steps_of
from surrogym_server.errors import InvalidInput
from surrogym_shared import frames
from surrogym_shared.wire import ResetSession, RolloutSession, StepSession

HEADER = "x-deadline-ms"
LONGEST_DIGITS = 9

PARAMETER: dict[str, Any] = {
    "name": HEADER,
    "in": "header",
    "required": False,
    "description": "How many milliseconds the caller waits for the reply. If it would come later, the step is refused.",
    "schema": {"type": "integer", "minimum": 1, "maximum": 10**LONGEST_DIGITS - 1},
}


def seconds_left(headers: Mapping[str, str]) -> float | None:
    """Return how long the caller of a request waits, in seconds, by the header ``x-deadline-ms``; None if the header is
    missing.

    Raises:
        InvalidInput: the header is not a whole number of milliseconds.
    """
    given = headers.get(HEADER)
    if given is None:
        return None
    if not (given.isascii() and given.isdigit() and len(given) <= LONGEST_DIGITS and int(given)):
        raise InvalidInput(f"{HEADER}: expected a whole number of milliseconds, at least 1, got {shown(given)}")
    return int(given) / 1e3


Operation = Literal["reset", "step", "rollout"]
Writers = Mapping[type[Advance], Callable[[Reply], bytes]]  # functions that write the reply to each kind of request

# The reply to a rollout of at most this many steps is written in the event loop. A longer one takes milliseconds, so a
# thread writes it.
SHORT_ROLLOUT = 32

FRAMES: Mapping[Operation, tuple[type[frames.Request], ...]] = {
    "reset": (frames.ResetRequest,),
    "step": (frames.StepRequest,),
    "rollout": (frames.RolloutRequest, frames.PolicyRequest),
}

_JSON = msgspec.json.Encoder()


def request_in_json(operation: Operation, session: str, content: bytes, within: float | None) -> Advance:
    """Read a reset, step or rollout from a JSON body. ``within`` is how long the caller waits, in seconds.

    Raises:
        HTTPException: the body is not valid JSON.
        RequestValidationError: a field is missing or invalid.
        InvalidInput: rows of an array have different lengths, or a policy's arrays contradict each other.
    """
    match operation:
        case "step":
            step = parse_as(StepSession, content)
            action, mask = numbers("action", step.action), sessions.lane_mask(step.mask)
            return Step(session, step.seq, action, mask, step.deviations, within)
        case "reset":
            reset = parse_as(ResetSession, content)
            return Reset(session, reset.seq, reset.seed, sessions.lane_mask(reset.mask), within)
        case "rollout":
            rollout = parse_as(RolloutSession, content)
            if rollout.actions is None:
                return PolicySteps(session, rollout.seq, sessions.policy_run(rollout), within)
            return Rollout(session, rollout.seq, numbers("actions", rollout.actions), within)


def frame_of(operation: Operation, content: bytes) -> frames.Request:
    """Read a binary frame from a body. Raises ``FrameError`` if the body is not a frame of this operation."""
    request = frames.read_request(content)
    if not isinstance(request, FRAMES[operation]):
        expected = " or ".join(str(kind.__struct_config__.tag) for kind in FRAMES[operation])
        raise frames.FrameError(
            f"expected a frame of the operation {expected}, got one of {request.__struct_config__.tag}: send it to the "
            "address of its operation"
        )
    return request


def request_in_frame(frame: frames.Request, session: str, shape: frames.Shape, within: float | None = None) -> Advance:
    """Convert a binary frame to a request of the engine. ``within`` is how long the caller waits, in seconds.

    ``shape`` has the sizes of the session's arrays. Raises ``FrameError`` if an array of the frame has another size.
    """
    match frame:
        case frames.StepRequest():
            action, mask = frames.action_of(frame, shape), frames.mask_of(frame, shape)
            return Step(session, frame.seq, action, mask, frame.deviations, within)
        case frames.ResetRequest():
            return Reset(session, frame.seq, frames.seed_of(frame, shape), frames.mask_of(frame, shape), within)
        case frames.RolloutRequest():
            return Rollout(session, frame.seq, frames.actions_of(frame, shape), within)
        case frames.PolicyRequest():
            return PolicySteps(session, frame.seq, sessions.framed_policy_run(frame, shape), within)


async def carried_out(engine: SessionEngine, request: Advance, writers: Writers) -> bytes:
    """Carry out a request, and return the reply as bytes. ``writers`` has the function that writes the reply to each
    kind of request. A long reply is written in a thread."""
    reply = await engine.advance(request)
    write = writers[type(request)]
    return write(reply) if steps_of(reply.outcome) <= SHORT_ROLLOUT else await asyncio.to_thread(write, reply)


def _reset_in_json(reply: Reply) -> bytes:
    return _JSON.encode(sessions.reset_reply(reply))


def _step_in_json(reply: Reply) -> bytes:
    return _JSON.encode(sessions.step_reply(reply))


def _rollout_in_json(reply: Reply) -> bytes:
    """Write the reply to a rollout as JSON. Each step is encoded separately, because the encoder blocks all other
    threads while it runs."""
    steps = [msgspec.Raw(_JSON.encode(step)) for step in sessions.rollout_steps(reply)]
    return _JSON.encode({"seq": reply.seq, "steps": steps, **sessions.rollout_actions(reply)})


def _reset_in_frame(reply: Reply) -> bytes:
    return frames.encode(sessions.reset_frame(reply))


def _step_in_frame(reply: Reply) -> bytes:
    return frames.encode(sessions.step_frame(reply))


def _rollout_in_frame(reply: Reply) -> bytes:
    return frames.encode(sessions.rollout_frame(reply))


AS_JSON: Writers = {
    Reset: _reset_in_json,
    Step: _step_in_json,
    Rollout: _rollout_in_json,
    PolicySteps: _rollout_in_json,
}
AS_FRAME: Writers = {
    Reset: _reset_in_frame,
    Step: _step_in_frame,
    Rollout: _rollout_in_frame,
    PolicySteps: _rollout_in_frame,
}
