"""Two encodings of reset, step and rollout: JSON, and the frames of ``surrogym_shared.frames``.

An encoding turns arguments into the body of a request, and the body of a reply into ``(seq, result)``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from surrogym_client.errors import error_from_problem, refused_here
from surrogym_shared import frames
from surrogym_shared.codes import Code, Problem
from surrogym_shared.frames import FrameError, Shape
from surrogym_shared.port import Bools, PolicyRollout, ResetResult, StepResult

if TYPE_CHECKING:
    from surrogym_shared.acting import PolicyRun

Array = NDArray[Any]
Seeds = int | Sequence[int] | None

UNREADABLE = (msgspec.DecodeError, FrameError)  # errors that decoding raises if a body is not a reply

R = TypeVar("R", frames.ResetReply, frames.StepReply, frames.RolloutReply, frames.PolicyReply)


class BinaryForm:
    """Encoding as frames with raw arrays. Shapes are not sent, so they are checked before an array is encoded."""

    media_type = frames.MEDIA_TYPE

    def reset(self, seq: int, seed: Seeds, mask: Bools | None, shape: Shape) -> bytes:
        try:
            return frames.encode(frames.reset_request(seq, _plain(seed), _mask(mask, shape)))
        except FrameError as error:
            raise refused_here(Code.INVALID_REQUEST, str(error)) from error

    def step(self, seq: int, action: Array, mask: Bools | None, deviations: bool, shape: Shape) -> bytes:
        rows = _rows("action", action, (shape.lanes, shape.action))
        return frames.encode(frames.step_request(seq, rows, _mask(mask, shape), deviations))

    def rollout(self, seq: int, actions: Array, shape: Shape) -> bytes:
        rows = _rows("actions", actions, (len(actions), shape.lanes, shape.action))
        return frames.encode(frames.rollout_request(seq, rows))

    def policy(self, seq: int, run: PolicyRun, shape: Shape) -> bytes:
        until = _mask(run.until, shape, "until")
        return frames.encode(frames.policy_request(seq, run.policy, run.steps, run.noise, until))

    def read_reset(self, content: bytes, shape: Shape) -> tuple[int, ResetResult]:
        reply = _reply(content, frames.ResetReply)
        return reply.seq, frames.reset_result(reply, shape)

    def read_step(self, content: bytes, shape: Shape) -> tuple[int, StepResult]:
        reply = _reply(content, frames.StepReply)
        return reply.seq, frames.step_result(reply.step, shape)

    def read_rollout(self, content: bytes, shape: Shape) -> tuple[int, list[StepResult]]:
        reply = _reply(content, frames.RolloutReply)
        return reply.seq, [frames.step_result(step, shape) for step in reply.steps]

    def read_policy(self, content: bytes, shape: Shape) -> tuple[int, PolicyRollout]:
        reply = _reply(content, frames.PolicyReply)
        return reply.seq, frames.policy_rollout(reply, shape)


class _ResetBody(msgspec.Struct, forbid_unknown_fields=True):
    """Fields of ``wire.ResetReply``, for fast decoding without a check of each number."""

    seq: int
    observation: list[list[float]]
    model_version: list[int]


class _StepBody(msgspec.Struct, forbid_unknown_fields=True):
    """Fields of ``wire.StepReply``, for fast decoding without a check of each number."""

    seq: int
    observation: list[list[float]]
    reward: list[float]
    terminated: list[bool]
    truncated: list[bool]
    model_version: list[int]
    reward_mean: list[float]
    final_lanes: list[int] = []
    final_observation: list[list[float]] = []
    deviation: list[list[float]] | None = None
    untrusted: list[bool] | None = None
    left: list[bool] | None = None


class _RolloutBody(msgspec.Struct, forbid_unknown_fields=True):
    seq: int
    steps: list[_StepBody]
    action: list[list[list[float]]] | None = None
    log_probability: list[list[float]] | None = None


_ENCODER = msgspec.json.Encoder()
_RESET = msgspec.json.Decoder(_ResetBody)
_STEP = msgspec.json.Decoder(_StepBody)
_ROLLOUT = msgspec.json.Decoder(_RolloutBody)


class JsonForm:
    """Encoding as JSON, which a person can read, but which takes several times as long as frames."""

    media_type = "application/json"

    def reset(self, seq: int, seed: Seeds, mask: Bools | None, shape: Shape) -> bytes:
        del shape  # not needed: JSON shows the shape, and the server checks it
        body = {"seq": seq, "seed": _plain(seed), "mask": _listed(mask)}
        return _ENCODER.encode({name: value for name, value in body.items() if value is not None})

    def step(self, seq: int, action: Array, mask: Bools | None, deviations: bool, shape: Shape) -> bytes:
        del shape
        body = {"seq": seq, "action": _sendable(action), "mask": _listed(mask), "deviations": deviations or None}
        return _ENCODER.encode({name: value for name, value in body.items() if value is not None})

    def rollout(self, seq: int, actions: Array, shape: Shape) -> bytes:
        del shape
        return _ENCODER.encode({"seq": seq, "actions": _sendable(actions)})

    def read_reset(self, content: bytes, shape: Shape) -> tuple[int, ResetResult]:
        del shape
        body = _RESET.decode(content)
        observation = np.array(body.observation, dtype=np.float32)
        return body.seq, ResetResult(observation, np.array(body.model_version, dtype=np.int64))

    def read_step(self, content: bytes, shape: Shape) -> tuple[int, StepResult]:
        body = _STEP.decode(content)
        return body.seq, _step_result(body, shape)

    def read_rollout(self, content: bytes, shape: Shape) -> tuple[int, list[StepResult]]:
        body = _ROLLOUT.decode(content)
        return body.seq, [_step_result(step, shape) for step in body.steps]

    def policy(self, seq: int, run: PolicyRun, shape: Shape) -> bytes:
        del shape
        policy = run.policy
        arrays = {
            "mean": policy.mean.tolist(),
            "deviation": policy.deviation.tolist(),
            "layers": [{name: part.tolist() for name, part in layer._asdict().items()} for layer in policy.layers],
            "activation": policy.activation,
            "precision": str(policy.dtype),
            "log_deviations": None if policy.log_deviations is None else policy.log_deviations.tolist(),
        }
        noise = None if run.noise is None else run.noise._asdict()
        body = {"seq": seq, "policy": arrays, "steps": run.steps, "noise": noise, "until": _listed(run.until)}
        return _ENCODER.encode(body)

    def read_policy(self, content: bytes, shape: Shape) -> tuple[int, PolicyRollout]:
        body = _ROLLOUT.decode(content)
        if not body.steps or body.action is None:
            raise FrameError(
                "expected steps and actions in the reply, got one alone: upgrade the older of client and server"
            )
        log = None if body.log_probability is None else np.array(body.log_probability, dtype=np.float64)
        steps = [_step_result(step, shape) for step in body.steps]
        return body.seq, PolicyRollout.of(steps, np.array(body.action, dtype=np.float64), log)


# Encoding of requests and replies. The methods that encode a request raise ``InvalidInput`` for values that can't be
# sent, such as NaN in JSON.
Form = BinaryForm | JsonForm


def _reply(content: bytes, kind: type[R]) -> R:
    """Parse a frame of the expected kind, or raise the error that a problem frame contains."""
    reply = frames.read_reply(content)
    if isinstance(reply, kind):
        return reply
    if isinstance(reply, frames.ProblemReply):
        fields = msgspec.structs.asdict(reply)
        del fields["seq"]
        raise error_from_problem(Problem(**fields))
    raise FrameError(f"expected a reply of the type {kind.__name__}, got {type(reply).__name__}")


def _rows(what: str, raw: Array, expected: tuple[int, ...]) -> Array:
    """Return actions as an array of the expected shape. Actions of one entry may lack the last axis."""
    array = np.asarray(raw)
    _require_numbers(array)
    if array.ndim == len(expected) - 1 and expected[-1] == 1:
        array = array[..., None]
    if array.shape != expected:
        raise refused_here(Code.INVALID_REQUEST, f"{what}: expected shape {expected}, got {np.shape(raw)}")
    return array


def _mask(mask: Bools | None, shape: Shape, name: str = "mask") -> Bools | None:
    if mask is not None and np.shape(mask) != (shape.lanes,):
        raise refused_here(Code.INVALID_REQUEST, f"{name}: expected shape ({shape.lanes},), got {np.shape(mask)}")
    return mask


def _plain(seed: Seeds) -> int | list[int] | None:
    if seed is None:
        return None
    return int(seed) if isinstance(seed, int | np.integer) else [int(s) for s in seed]


def _listed(mask: Bools | None) -> list[bool] | None:
    return None if mask is None else np.asarray(mask, dtype=bool).tolist()


def _sendable(action: Array) -> Any:
    """Return actions as nested lists. Values that JSON can't represent are refused here; the server checks the rest."""
    array = np.asarray(action)
    _require_numbers(array)
    if not np.isfinite(array).all():
        place = np.argwhere(~np.isfinite(array))[0].tolist()
        value = array[tuple(place)]
        raise refused_here(Code.INVALID_REQUEST, f"action{place}: expected a finite number, got {value}")
    return array.tolist()


def _require_numbers(array: Array) -> None:
    if array.dtype.kind not in "biuf":
        raise refused_here(Code.INVALID_REQUEST, f"action: expected an array of numbers, got dtype {array.dtype}")


def _step_result(body: _StepBody, shape: Shape) -> StepResult:
    final = np.array(body.final_observation, dtype=np.float32)
    return StepResult(
        observation=np.array(body.observation, dtype=np.float32),
        reward=np.array(body.reward, dtype=np.float64),
        terminated=np.array(body.terminated, dtype=bool),
        truncated=np.array(body.truncated, dtype=bool),
        final_lanes=np.array(body.final_lanes, dtype=np.int64),
        final_observation=final.reshape(len(body.final_lanes), shape.observation),
        model_version=np.array(body.model_version, dtype=np.int64),
        reward_mean=np.array(body.reward_mean, dtype=np.float64),
        deviation=None if body.deviation is None else np.array(body.deviation, dtype=np.float64),
        untrusted=None if body.untrusted is None else np.array(body.untrusted, dtype=bool),
        left=None if body.left is None else np.array(body.left, dtype=bool),
    )
