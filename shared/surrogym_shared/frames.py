"""The binary form of reset, step and rollout: msgpack maps whose arrays are raw little-endian bytes.

A frame names its operation in ``op``. It has no dtypes and shapes, which both sides know from the session. The same
frames are HTTP bodies of type ``MEDIA_TYPE`` and messages of the WebSocket.

Shapes: N lanes, D observation entries, F action entries, O model outputs, T steps, K lanes whose episode ended.

========================================  ===========  ==============================
field                                     shape        dtype
========================================  ===========  ==============================
action, actions                           (N, F)       float64; actions (T, N, F)
mask, terminated, truncated, untrusted    (N,)         bool: one byte, 0 or 1
left                                      (N,)         bool
seed (of each lane)                       (N,)         int64
observation                               (N, D)       float32
reward, reward_mean                       (N,)         float64
final_lanes, final_observation            (K,) (K, D)  int64, float32
model_version                             (N,)         int64
deviation                                 (N, O)       float64
========================================  ===========  ==============================

A rollout of a policy has ``op`` policy. Its arrays have the policy's precision, float32 or float64: mean and deviation
(D,), log_deviations (F,), and ``parameters``: for each layer in order, the weights (inputs, units) and the bias
(units,). ``until`` (N,) is bool: the rollout stops once an episode has ended in each lane that it marks.

The reply has the arrays above with a first axis of T steps, action (T, N, F), log_probability (T, N), and final_steps
(K,) as int64 beside final_lanes. To save bytes without a loss, action and log_probability are float32 if that
represents them exactly (``precision``), reward_mean is left out if it equals the reward, and model_version is (N,) if
it never changes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from surrogym_shared.codes import Code
from surrogym_shared.kinds import Activation
from surrogym_shared.policy_sizes import MAX_LAYERS, MAX_PARAMETERS, MAX_UNITS
from surrogym_shared.port import PolicyRollout, ResetResult, StepResult, quick
from surrogym_shared.wire import MAX_ROLLOUT, ActionSpace, BoxSpace, DiscreteSpace, MultiDiscreteSpace, SessionView

if TYPE_CHECKING:
    from surrogym_shared.acting import ActingPolicy, NoiseKey

MEDIA_TYPE = "application/vnd.msgpack"

Array = NDArray[Any]
Bools = NDArray[np.bool_]

FLOAT32, FLOAT64, INT64 = np.dtype("<f4"), np.dtype("<f8"), np.dtype("<i8")
BOOL = np.dtype("?")

Seq = Annotated[int, msgspec.Meta(ge=1)]
Seed = Annotated[int, msgspec.Meta(ge=0)]
Word = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
Units = Annotated[int, msgspec.Meta(ge=1, le=MAX_UNITS)]


class FrameError(ValueError):
    """Bytes that are not a frame, or arrays that don't fit the session. The message says what was expected and what
    came."""


@dataclass(frozen=True, slots=True)
class Shape:
    """Sizes of a session's arrays: numbers of lanes, observation entries, action entries and model outputs."""

    lanes: int
    observation: int
    action: int
    outputs: int

    @classmethod
    def of(cls, view: SessionView) -> Self:
        return cls(
            lanes=view.num_envs,
            observation=len(view.observation_space.low),
            action=_size(view.action_space),
            outputs=len(view.outputs),
        )


class Frame(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True, tag_field="op"):
    """Base class of all frames: msgpack maps that name their operation in ``op``."""


class ResetRequest(Frame, frozen=True, tag="reset"):
    seq: Seq | None = None
    seed: Seed | memoryview | None = None
    mask: memoryview | None = None


class StepRequest(Frame, frozen=True, tag="step", kw_only=True):
    seq: Seq | None = None
    action: memoryview
    mask: memoryview | None = None
    deviations: bool = False


class RolloutRequest(Frame, frozen=True, tag="rollout", kw_only=True):
    seq: Seq | None = None
    actions: memoryview


class Noise(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    seed: Word
    step: Word
    hold: Annotated[int, msgspec.Meta(ge=1, le=MAX_ROLLOUT)] = 1


class PolicyRequest(Frame, frozen=True, tag="policy", kw_only=True):
    """Request to let a policy act for several steps. ``units`` are the numbers of outputs of its network's layers."""

    seq: Seq | None = None
    steps: Annotated[int, msgspec.Meta(ge=1, le=MAX_ROLLOUT)]
    mean: memoryview
    deviation: memoryview
    units: Annotated[list[Units], msgspec.Meta(min_length=1, max_length=MAX_LAYERS)]
    parameters: memoryview
    activation: Activation
    precision: Literal["float32", "float64"]
    log_deviations: memoryview | None = None
    noise: Noise | None = None
    until: memoryview | None = None


class Step(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Result of one step of N lanes, with arrays as raw bytes."""

    observation: memoryview
    reward: memoryview
    terminated: memoryview
    truncated: memoryview
    model_version: memoryview
    reward_mean: memoryview
    final_lanes: memoryview | None = None
    final_observation: memoryview | None = None
    deviation: memoryview | None = None
    untrusted: memoryview | None = None
    left: memoryview | None = None


class ResetReply(Frame, frozen=True, tag="reset"):
    seq: Seq
    observation: memoryview
    model_version: memoryview


class StepReply(Frame, frozen=True, tag="step"):
    seq: Seq
    step: Step


class RolloutReply(Frame, frozen=True, tag="rollout"):
    seq: Seq
    steps: list[Step]


class PolicyReply(Frame, frozen=True, tag="policy", kw_only=True):
    seq: Seq
    precision: Literal["float32", "float64"]
    action: memoryview
    log_probability: memoryview | None = None
    observation: memoryview
    reward: memoryview
    terminated: memoryview
    truncated: memoryview
    model_version: memoryview
    reward_mean: memoryview | None = None
    final_steps: memoryview | None = None
    final_lanes: memoryview | None = None
    final_observation: memoryview | None = None
    untrusted: memoryview | None = None
    left: memoryview | None = None


class ProblemReply(Frame, frozen=True, tag="problem"):
    """Error reply on the WebSocket: a problem body (RFC 9457). ``seq`` is the number of the refused request, if any."""

    status: int
    code: Code
    title: str
    detail: str
    expected_seq: int | None = None
    seq: int | None = None


Request = ResetRequest | StepRequest | RolloutRequest | PolicyRequest
Reply = ResetReply | StepReply | RolloutReply | PolicyReply | ProblemReply
T = TypeVar("T")

_ENCODER = msgspec.msgpack.Encoder()
_REQUEST: msgspec.msgpack.Decoder[Request] = msgspec.msgpack.Decoder(Request)
_REPLY: msgspec.msgpack.Decoder[Reply] = msgspec.msgpack.Decoder(Reply)


def encode(frame: Frame) -> bytes:
    """Return a frame as bytes."""
    return _ENCODER.encode(frame)


def read_request(content: bytes) -> Request:
    """Parse a request. Its arrays are views of the bytes. Raises ``FrameError``."""
    return _read(_REQUEST, content)


def read_reply(content: bytes) -> Reply:
    """Parse a reply. Its arrays are views of the bytes. Raises ``FrameError``."""
    return _read(_REPLY, content)


# Build requests from arrays, and read arrays from requests


def reset_request(seq: int | None, seed: int | Sequence[int] | None, mask: Bools | None) -> ResetRequest:
    """Build the request of a reset, with its number ``seq`` in the session. The seed is one integer, one integer for
    each lane, or None for no new seed. ``mask`` (N,) is True for the lanes to reset; None resets all.

    Raises:
        FrameError: int64 can't represent a seed.
    """
    seeds = None if seed is None else _seeds(seed)
    seed_field = int(seed) if isinstance(seed, int) else seeds
    return ResetRequest(seq, seed_field, None if mask is None else _flat(mask, BOOL))


def step_request(seq: int | None, action: Array, mask: Bools | None, deviations: bool) -> StepRequest:
    """Build the request of a step with the actions (N, F) of N lanes. ``mask`` (N,) is True for the lanes to step; None
    steps all. With ``deviations``, the reply has the predicted standard deviation of each output."""
    view = None if mask is None else _flat(mask, BOOL)
    return StepRequest(seq=seq, action=_flat(action, FLOAT64), mask=view, deviations=deviations)


def rollout_request(seq: int | None, actions: Array) -> RolloutRequest:
    """Build the request of a rollout with actions (T, N, F): T steps of N lanes, with F action entries."""
    return RolloutRequest(seq=seq, actions=_flat(actions, FLOAT64))


def policy_request(
    seq: int | None, policy: ActingPolicy, steps: int, noise: NoiseKey | None, until: Bools | None
) -> PolicyRequest:
    """Build the request of a policy's rollout of at most ``steps`` steps. The rollout stops once an episode has ended
    in each lane of the mask ``until`` (N,). A ``noise`` of None takes the most probable actions."""
    dtype = FLOAT32 if policy.dtype == np.float32 else FLOAT64
    return PolicyRequest(
        seq=seq,
        steps=steps,
        mean=_flat(policy.mean, dtype),
        deviation=_flat(policy.deviation, dtype),
        units=list(policy.units),
        parameters=_flat(policy.vector, dtype),
        activation=policy.activation,
        precision="float32" if dtype is FLOAT32 else "float64",
        log_deviations=None if policy.log_deviations is None else _flat(policy.log_deviations, dtype),
        noise=None if noise is None else Noise(*noise),
        until=None if until is None else _flat(until, BOOL),
    )


def seed_of(request: ResetRequest, shape: Shape) -> int | list[int] | None:
    """Return the seed of a reset request: one integer, one for each of N lanes, or None. Raises ``FrameError``."""
    if not isinstance(request.seed, memoryview):
        return request.seed
    seeds: list[int] = _array("seed", request.seed, INT64, (shape.lanes,)).tolist()
    return seeds


def mask_of(request: ResetRequest | StepRequest, shape: Shape) -> Bools | None:
    """Return the mask (N,) of the lanes to reset or step; None for all lanes. Raises ``FrameError``."""
    return None if request.mask is None else _array("mask", _checked("mask", request.mask), BOOL, (shape.lanes,))


def action_of(request: StepRequest, shape: Shape) -> NDArray[np.float64]:
    """Return the actions (N, F) of N lanes in a request, as a view of the frame. Raises ``FrameError``."""
    return _array("action", request.action, FLOAT64, (shape.lanes, shape.action))


def actions_of(request: RolloutRequest, shape: Shape) -> NDArray[np.float64]:
    """Return the actions (T, N, F) of T steps of N lanes, as a view of the frame. Raises ``FrameError``."""
    lanes, size, nbytes = shape.lanes, shape.action, request.actions.nbytes
    steps, rest = divmod(nbytes, lanes * size * FLOAT64.itemsize)
    if rest or not 1 <= steps <= MAX_ROLLOUT:
        raise FrameError(f"actions: expected 1 to {MAX_ROLLOUT} steps of {lanes} x {size} float64, got {nbytes} bytes")
    return _array("actions", request.actions, FLOAT64, (steps, lanes, size))


def policy_of(request: PolicyRequest, shape: Shape) -> ActingPolicy:
    """Return the policy of a request, as views of the frame. Raises ``FrameError``."""
    from surrogym_shared.acting import ActingPolicy, layers_of, parameters_of  # imported late: steps do not need it

    dtype, size = FLOAT32 if request.precision == "float32" else FLOAT64, shape.observation
    if (count := parameters_of(size, request.units)) > MAX_PARAMETERS:
        raise FrameError(f"policy: expected at most {MAX_PARAMETERS} weights and biases, got {count}")
    log = request.log_deviations
    entries = 0 if log is None else log.nbytes // dtype.itemsize
    try:
        return ActingPolicy(
            mean=_aligned("mean", request.mean, dtype, (size,)),
            deviation=_aligned("deviation", request.deviation, dtype, (size,)),
            layers=layers_of((size, *request.units), _aligned("parameters", request.parameters, dtype, (count,))),
            activation=request.activation,
            log_deviations=None if log is None else _aligned("log_deviations", log, dtype, (entries,)),
        )
    except FrameError:
        raise
    except ValueError as error:
        raise FrameError(str(error)) from error


def noise_of(request: PolicyRequest) -> NoiseKey | None:
    from surrogym_shared.acting import NoiseKey

    return None if request.noise is None else NoiseKey(*msgspec.structs.astuple(request.noise))


def until_of(request: PolicyRequest, shape: Shape) -> Bools | None:
    """Return the mask (N,) of the lanes whose episodes have to end before the rollout stops. Raises ``FrameError``."""
    return None if request.until is None else _array("until", _checked("until", request.until), BOOL, (shape.lanes,))


# Build replies from results, and read results from replies


def reset_reply(seq: int, result: ResetResult) -> ResetReply:
    return ResetReply(seq, _flat(result.observation, FLOAT32), _flat(result.model_version, INT64))


def step_reply(seq: int, result: StepResult) -> StepReply:
    return StepReply(seq, _step(result))


def rollout_reply(seq: int, results: Sequence[StepResult]) -> RolloutReply:
    return RolloutReply(seq, [_step(result) for result in results])


def policy_reply(seq: int, result: PolicyRollout) -> PolicyReply:
    has_ends = len(result.final_lanes) > 0
    log, versions, untrusted = result.log_probability, result.model_version, result.untrusted
    reward, mean = _flat(result.reward, FLOAT64), _flat(result.reward_mean, FLOAT64)
    with np.errstate(over="ignore"):
        short = all(one is None or np.array_equal(one, one.astype(FLOAT32)) for one in (result.action, log))
    dtype = FLOAT32 if short else FLOAT64
    return PolicyReply(
        seq=seq,
        precision="float32" if short else "float64",
        action=_flat(result.action, dtype),
        log_probability=None if log is None else _flat(log, dtype),
        observation=_flat(result.observation, FLOAT32),
        reward=reward,
        terminated=_flat(result.terminated, BOOL),
        truncated=_flat(result.truncated, BOOL),
        model_version=_flat(versions[0] if (versions == versions[0]).all() else versions, INT64),
        # Left out if equal to ``reward``. Bytes are compared, because 0.0 == -0.0 as numbers.
        reward_mean=None if mean.tobytes() == reward.tobytes() else mean,
        final_steps=_flat(result.final_steps, INT64) if has_ends else None,
        final_lanes=_flat(result.final_lanes, INT64) if has_ends else None,
        final_observation=_flat(result.final_observation, FLOAT32) if has_ends else None,
        untrusted=None if untrusted is None else _flat(untrusted, BOOL),
        left=None if result.left is None else _flat(result.left, BOOL),
    )


def policy_rollout(reply: PolicyReply, shape: Shape) -> PolicyRollout:
    """Convert the reply of a policy's rollout. Its arrays are aligned and writable copies. Raises ``FrameError``."""
    steps, log, untrusted = reply.reward.nbytes // (8 * shape.lanes), reply.log_probability, reply.untrusted
    each, dtype = (steps, shape.lanes), FLOAT32 if reply.precision == "float32" else FLOAT64
    final_lanes, final_observation = _final(reply, shape)
    reward = _own("reward", reply.reward, FLOAT64, each)
    mean = None if reply.reward_mean is None else _own("reward_mean", reply.reward_mean, FLOAT64, each)
    return PolicyRollout(
        action=_array("action", reply.action, dtype, (*each, shape.action)).astype(np.float64),
        log_probability=None if log is None else _array("log_probability", log, dtype, each).astype(np.float64),
        observation=_own("observation", reply.observation, FLOAT32, (*each, shape.observation)),
        reward=reward,
        terminated=_own("terminated", _checked("terminated", reply.terminated), BOOL, each),
        truncated=_own("truncated", _checked("truncated", reply.truncated), BOOL, each),
        final_steps=_final_steps(reply, steps, len(final_lanes)),
        final_lanes=final_lanes,
        final_observation=final_observation,
        model_version=_versions(reply.model_version, each),
        reward_mean=reward.copy() if mean is None else mean,
        untrusted=None if untrusted is None else _own("untrusted", _checked("untrusted", untrusted), BOOL, each),
        left=None if reply.left is None else _own("left", _checked("left", reply.left), BOOL, each),
    )


def _versions(view: memoryview, each: tuple[int, int]) -> Array:
    """Return model versions (T, N). If the frame has only one version for each lane, repeat it for each of T steps."""
    one = each[1] * INT64.itemsize
    if view.nbytes == one:
        return np.repeat(_own("model_version", view, INT64, each[1:])[None], each[0], 0)
    return _own("model_version", view, INT64, each)


def reset_result(reply: ResetReply, shape: Shape) -> ResetResult:
    """Convert the reply of a reset. Its arrays are aligned and writable copies. Raises ``FrameError``."""
    lanes = shape.lanes
    return ResetResult(
        observation=_own("observation", reply.observation, FLOAT32, (lanes, shape.observation)),
        model_version=_own("model_version", reply.model_version, INT64, (lanes,)),
    )


def step_result(step: Step, shape: Shape) -> StepResult:
    """Convert the reply of a step. Its arrays are aligned and writable copies. Raises ``FrameError``."""
    each = (shape.lanes,)
    final_lanes, final_observation = _final(step, shape)
    deviation = None
    if step.deviation is not None:
        deviation = _own("deviation", step.deviation, FLOAT64, (shape.lanes, shape.outputs))
    return quick(
        StepResult,
        observation=_own("observation", step.observation, FLOAT32, (shape.lanes, shape.observation)),
        reward=_own("reward", step.reward, FLOAT64, each),
        terminated=_own("terminated", _checked("terminated", step.terminated), BOOL, each),
        truncated=_own("truncated", _checked("truncated", step.truncated), BOOL, each),
        final_lanes=final_lanes,
        final_observation=final_observation,
        model_version=_own("model_version", step.model_version, INT64, each),
        reward_mean=_own("reward_mean", step.reward_mean, FLOAT64, each),
        deviation=deviation,
        untrusted=None
        if step.untrusted is None
        else _own("untrusted", _checked("untrusted", step.untrusted), BOOL, each),
        left=None if step.left is None else _own("left", _checked("left", step.left), BOOL, each),
    )


def _step(result: StepResult) -> Step:
    has_ends = len(result.final_lanes) > 0
    return Step(
        _flat(result.observation, FLOAT32),
        _flat(result.reward, FLOAT64),
        _flat(result.terminated, BOOL),
        _flat(result.truncated, BOOL),
        _flat(result.model_version, INT64),
        _flat(result.reward_mean, FLOAT64),
        _flat(result.final_lanes, INT64) if has_ends else None,
        _flat(result.final_observation, FLOAT32) if has_ends else None,
        None if result.deviation is None else _flat(result.deviation, FLOAT64),
        None if result.untrusted is None else _flat(result.untrusted, BOOL),
        None if result.left is None else _flat(result.left, BOOL),
    )


def _final_steps(reply: PolicyReply, steps: int, count: int) -> Array:
    """Return the steps (K,) at which the K episodes in ``final_lanes`` ended, in order."""
    final_steps = _own(
        "final_steps", memoryview(b"") if reply.final_steps is None else reply.final_steps, INT64, (count,)
    )
    if count and (final_steps[0] < 0 or final_steps[-1] >= steps or (np.diff(final_steps) < 0).any()):
        raise FrameError(
            f"final_steps: expected numbers from 0 to {steps - 1} in order, got {final_steps[:8].tolist()}"
        )
    return final_steps


def _final(step: Step | PolicyReply, shape: Shape) -> tuple[Array, Array]:
    """Return the K lanes (K,) whose episode ended, and the last observations (K, D) of these episodes."""
    if step.final_lanes is None or step.final_observation is None:
        if step.final_lanes is not step.final_observation:
            raise FrameError("expected final_lanes and final_observation together, got one of them")
        return np.zeros(0, dtype=INT64), np.zeros((0, shape.observation), dtype=FLOAT32)
    count = step.final_lanes.nbytes // INT64.itemsize
    lanes = _own("final_lanes", step.final_lanes, INT64, (count,))
    if count == 0 or lanes.min() < 0 or lanes.max() >= shape.lanes:
        raise FrameError(f"final_lanes: expected numbers from 0 to {shape.lanes - 1}, got {lanes[:8].tolist()}")
    return lanes, _own("final_observation", step.final_observation, FLOAT32, (count, shape.observation))


# Convert arrays to bytes, and bytes to arrays


def _size(space: ActionSpace) -> int:
    match space:
        case BoxSpace():
            return len(space.low)
        case DiscreteSpace():
            return 1
        case MultiDiscreteSpace():
            return len(space.nvec)


def _flat(array: Array, dtype: np.dtype[Any]) -> memoryview:
    """Return the bytes of an array as a view of its memory if it is contiguous and of this dtype; otherwise of a
    converted copy."""
    return np.ascontiguousarray(array, dtype).data


def _array(name: str, view: memoryview, dtype: np.dtype[Any], shape: tuple[int, ...]) -> Array:
    """Return bytes as an array, which is a view of the frame."""
    _require_size(name, view, dtype, shape)
    return np.ndarray(shape, dtype, view)


def _own(name: str, view: memoryview, dtype: np.dtype[Any], shape: tuple[int, ...]) -> Array:
    """Return bytes as an array, which is a writable copy."""
    _require_size(name, view, dtype, shape)
    return np.ndarray(shape, dtype, bytearray(view))


def _aligned(name: str, view: memoryview, dtype: np.dtype[Any], shape: tuple[int, ...]) -> Array:
    """Return bytes as an array, which is an aligned copy. Matrix products of an aligned array are faster, and always
    round in the same way."""
    return _array(name, view, dtype, shape).copy()


def _require_size(name: str, view: memoryview, dtype: np.dtype[Any], shape: tuple[int, ...]) -> None:
    size = math.prod(shape) * dtype.itemsize
    if view.nbytes != size:
        raise FrameError(f"{name}: expected {size} bytes, shape {shape} of {dtype.name}, got {view.nbytes} bytes")


def _checked(name: str, view: memoryview) -> memoryview:
    if bytes(view).strip(b"\x00\x01"):  # something is left if a byte is neither 0 nor 1
        raise FrameError(f"{name}: expected booleans as bytes of 0 or 1, got other bytes")
    return view


def _seeds(seed: int | Sequence[int]) -> memoryview:
    try:
        return np.array(seed, dtype=INT64).data
    except (OverflowError, TypeError, ValueError) as error:
        raise FrameError(f"seed: expected whole numbers from 0 to 2^63 - 1, got {seed}") from error


def _read(decoder: msgspec.msgpack.Decoder[T], content: bytes) -> T:
    try:
        return decoder.decode(content)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise FrameError(
            f"expected a binary frame (msgpack), got {len(content)} bytes that can't be read as one: {error}"
        ) from error
