"""Frames carry every bit there and back, and bytes that are none are told, whatever they are."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import fields, replace
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from support.acting import assert_same_rollout, random_policy
from surrogym_shared import frames
from surrogym_shared.acting import ActingPolicy, NoiseKey
from surrogym_shared.codes import Code
from surrogym_shared.frames import FrameError, Shape
from surrogym_shared.port import PolicyRollout, ResetResult, StepResult

SEQ = st.integers(1, 2**63 - 1)
SHAPES = st.builds(Shape, st.integers(1, 5), st.integers(1, 4), st.integers(1, 3), st.integers(1, 3))
SMALL = Shape(lanes=2, observation=3, action=1, outputs=2)


def floats(shape: tuple[int, ...], dtype: Any = np.float64) -> st.SearchStrategy[np.ndarray]:
    return arrays.arrays(dtype, shape, elements={"allow_nan": False, "allow_infinity": False})


@st.composite
def step_results(draw: st.DrawFn, shape: Shape) -> StepResult:
    lanes = shape.lanes
    final = sorted(draw(st.sets(st.integers(0, lanes - 1))))
    return StepResult(
        observation=draw(floats((lanes, shape.observation), np.float32)),
        reward=draw(floats((lanes,))),
        terminated=draw(arrays.arrays(bool, lanes)),
        truncated=draw(arrays.arrays(bool, lanes)),
        final_lanes=np.array(final, dtype=np.int64),
        final_observation=draw(floats((len(final), shape.observation), np.float32)),
        model_version=draw(arrays.arrays(np.int64, lanes)),
        reward_mean=draw(floats((lanes,))),
        deviation=draw(st.none() | floats((lanes, shape.outputs))),
        untrusted=draw(st.none() | arrays.arrays(bool, lanes)),
        left=draw(st.none() | arrays.arrays(bool, lanes)),
    )


def assert_same(ours: ResetResult | StepResult, theirs: ResetResult | StepResult) -> None:
    for field in fields(ours):
        our, their = getattr(ours, field.name), getattr(theirs, field.name)
        assert (our is None) == (their is None), field.name
        if our is not None:
            assert (our.dtype, our.shape, our.tobytes()) == (their.dtype, their.shape, their.tobytes()), field.name


@given(data=st.data(), shape=SHAPES, seq=SEQ)
def test_steps_survive_binary_encoding_bit_for_bit(data: st.DataObject, shape: Shape, seq: int):
    results = data.draw(st.lists(step_results(shape), min_size=1, max_size=2))
    one = frames.read_reply(frames.encode(frames.step_reply(seq, results[0])))
    assert isinstance(one, frames.StepReply)
    assert one.seq == seq
    assert_same(frames.step_result(one.step, shape), results[0])
    many = frames.read_reply(frames.encode(frames.rollout_reply(seq, results)))
    assert isinstance(many, frames.RolloutReply)
    for step, result in zip(many.steps, results, strict=True):
        assert_same(frames.step_result(step, shape), result)


@given(data=st.data(), shape=SHAPES)
def test_a_reset_reply_survives_binary_encoding_bit_for_bit(data: st.DataObject, shape: Shape):
    observation = data.draw(floats((shape.lanes, shape.observation), np.float32))
    result = ResetResult(observation, data.draw(arrays.arrays(np.int64, shape.lanes)))
    reply = frames.read_reply(frames.encode(frames.reset_reply(3, result)))
    assert isinstance(reply, frames.ResetReply)
    assert_same(frames.reset_result(reply, shape), result)


@given(data=st.data(), shape=SHAPES, seq=st.none() | SEQ, deviations=st.booleans())
def test_requests_survive_binary_encoding_bit_for_bit(
    data: st.DataObject, shape: Shape, seq: int | None, deviations: bool
):
    lanes = shape.lanes
    mask = data.draw(st.none() | arrays.arrays(bool, lanes))
    actions = data.draw(floats((3, lanes, shape.action)))
    step = frames.read_request(frames.encode(frames.step_request(seq, actions[0], mask, deviations)))
    assert isinstance(step, frames.StepRequest)
    assert (step.seq, step.deviations) == (seq, deviations)
    assert frames.action_of(step, shape).tobytes() == actions[0].tobytes()
    np.testing.assert_array_equal(frames.mask_of(step, shape), mask)
    rollout = frames.read_request(frames.encode(frames.rollout_request(seq, actions)))
    assert isinstance(rollout, frames.RolloutRequest)
    assert frames.actions_of(rollout, shape).tobytes() == actions.tobytes()
    seed = data.draw(st.none() | st.integers(0, 2**63 - 1) | st.lists(st.integers(0, 2**63 - 1), min_size=lanes))
    reset = frames.read_request(frames.encode(frames.reset_request(seq, seed, mask)))
    assert isinstance(reset, frames.ResetRequest)
    if not isinstance(seed, list) or len(seed) == lanes:
        assert frames.seed_of(reset, shape) == seed


POLICIES = [random_policy((3, 4, 1)), random_policy((3, 2), np.float64, continuous=False)]


@pytest.mark.parametrize("policy", POLICIES, ids=["float32", "float64"])
@pytest.mark.parametrize("noise", [None, NoiseKey(2**63 - 1, 2**63 - 1), NoiseKey(3, 64, hold=16)])
def test_a_policy_survives_binary_encoding_bit_for_bit(policy: ActingPolicy, noise: NoiseKey | None):
    until = np.array([True, False])
    request = frames.read_request(frames.encode(frames.policy_request(5, policy, 9, noise, until)))
    assert isinstance(request, frames.PolicyRequest)
    back = frames.policy_of(request, SMALL)
    assert (request.seq, request.steps, frames.noise_of(request)) == (5, 9, noise)
    np.testing.assert_array_equal(frames.until_of(request, SMALL), until)
    assert (back.activation, back.units, back.dtype) == (policy.activation, policy.units, policy.dtype)
    for name in ("mean", "deviation", "vector", "log_deviations"):
        ours, theirs = getattr(back, name), getattr(policy, name)
        np.testing.assert_array_equal(ours, theirs, strict=theirs is not None)


@given(data=st.data(), shape=SHAPES)
def test_the_actions_of_a_policy_rollout_survive_binary_encoding_bit_for_bit(data: st.DataObject, shape: Shape):
    trusted = data.draw(st.booleans())
    drawn = data.draw(st.lists(step_results(shape), min_size=1, max_size=3))
    marks = [one.terminated if trusted else None for one in drawn]
    steps = [replace(one, deviation=None, untrusted=mark, left=mark) for one, mark in zip(drawn, marks, strict=True)]
    log = data.draw(st.none() | floats((len(steps), shape.lanes)))
    result = PolicyRollout.of(steps, data.draw(floats((len(steps), shape.lanes, shape.action))), log)
    reply = frames.read_reply(frames.encode(frames.policy_reply(3, result)))
    assert isinstance(reply, frames.PolicyReply)
    back = frames.policy_rollout(reply, shape)
    assert_same_rollout(back, result)
    for ours, theirs in zip(back.steps(), steps, strict=True):
        assert_same(ours, theirs)


def test_binary_encoding_keeps_a_mean_reward_of_minus_zero():
    step = replace(example(), deviation=None, reward=np.zeros(SMALL.lanes), reward_mean=np.full(SMALL.lanes, -0.0))
    result = PolicyRollout.of([step], np.zeros((1, SMALL.lanes, SMALL.action)), None)
    reply = frames.read_reply(frames.encode(frames.policy_reply(3, result)))
    assert isinstance(reply, frames.PolicyReply)
    assert np.signbit(frames.policy_rollout(reply, SMALL).reward_mean).all()


def test_arrays_of_any_memory_layout_are_encoded_in_row_order():
    action = np.arange(6, dtype=np.float32).reshape(3, 2).T
    request = frames.step_request(1, action, None, False)
    np.testing.assert_array_equal(frames.action_of(request, Shape(2, 1, 3, 1)), action)


def test_decoded_arrays_are_writable_and_aligned():
    reply = frames.read_reply(frames.encode(frames.step_reply(1, example())))
    assert isinstance(reply, frames.StepReply)
    result = frames.step_result(reply.step, SMALL)
    for field in fields(result):
        array = getattr(result, field.name)
        assert array.flags.writeable, field.name
        assert array.flags.aligned, field.name


def test_an_error_reply_survives_binary_encoding():
    sent = frames.ProblemReply(409, Code.SEQ_CONFLICT, "seq conflict", "expected seq 3, got 4", 3, 4)
    assert frames.read_reply(frames.encode(sent)) == sent


# What is no frame


def example() -> StepResult:
    return StepResult(
        observation=np.ones((2, 3), dtype=np.float32),
        reward=np.ones(2),
        terminated=np.array([True, False]),
        truncated=np.array([False, False]),
        final_lanes=np.array([0]),
        final_observation=np.zeros((1, 3), dtype=np.float32),
        model_version=np.array([1, 2]),
        reward_mean=np.ones(2),
        deviation=np.ones((2, 2)),
        untrusted=np.array([False, True]),
        left=np.array([True, False]),
    )


def policy_example() -> PolicyRollout:
    return PolicyRollout.of([replace(example(), deviation=None)] * 2, np.ones((2, 2, 1)), np.ones((2, 2)))


def of_policy(**changes: Any) -> frames.PolicyRequest:
    request = frames.policy_request(1, POLICIES[0], 2, None, None)
    return msgspec.structs.replace(request, **changes)


def read_whole_request(content: bytes) -> None:
    request = frames.read_request(content)
    match request:
        case frames.StepRequest():
            frames.action_of(request, SMALL)
            frames.mask_of(request, SMALL)
        case frames.RolloutRequest():
            frames.actions_of(request, SMALL)
        case frames.ResetRequest():
            frames.seed_of(request, SMALL)
            frames.mask_of(request, SMALL)
        case frames.PolicyRequest():
            frames.policy_of(request, SMALL)
            frames.noise_of(request)
            frames.until_of(request, SMALL)


def read_whole_reply(content: bytes) -> None:
    reply = frames.read_reply(content)
    match reply:
        case frames.StepReply():
            frames.step_result(reply.step, SMALL)
        case frames.RolloutReply():
            [frames.step_result(step, SMALL) for step in reply.steps]
        case frames.ResetReply():
            frames.reset_result(reply, SMALL)
        case frames.PolicyReply():
            frames.policy_rollout(reply, SMALL)


MASK = np.array([True, False])
REQUESTS = [
    frames.reset_request(1, [3, 4], MASK),
    frames.step_request(1, np.ones((2, 1)), MASK, True),
    frames.rollout_request(1, np.ones((2, 2, 1))),
    frames.policy_request(1, random_policy((3, 2, 1)), 4, NoiseKey(1, 2), MASK),
]
REPLIES = [
    frames.reset_reply(1, ResetResult(np.ones((2, 3), dtype=np.float32), np.array([1, 2]))),
    frames.step_reply(1, example()),
    frames.rollout_reply(1, [example()] * 2),
    frames.policy_reply(
        1, PolicyRollout.of([replace(example(), deviation=None)] * 2, np.ones((2, 2, 1)), np.ones((2, 2)))
    ),
    frames.ProblemReply(404, Code.UNKNOWN_SESSION, "unknown session", "no session"),
]
CASES = [(read_whole_request, frames.encode(r)) for r in REQUESTS]
CASES += [(read_whole_reply, frames.encode(r)) for r in REPLIES]


@given(case=st.sampled_from(CASES), data=st.data())
def test_a_binary_frame_with_changed_bytes_decodes_or_raises_frame_error(
    case: tuple[Callable[[bytes], None], bytes], data: st.DataObject
):
    read, content = case
    at = data.draw(st.integers(0, len(content) - 1))
    until = data.draw(st.integers(at, min(len(content), at + 8)))
    mutated = content[:at] + data.draw(st.binary(max_size=8)) + content[until:]
    with suppress(FrameError):
        read(mutated)


@given(content=st.binary(max_size=64))
def test_random_bytes_decode_as_a_frame_or_raise_frame_error(content: bytes):
    for read in (read_whole_request, read_whole_reply):
        with suppress(FrameError):
            read(content)


@pytest.mark.parametrize(("read", "content"), CASES)
def test_every_truncated_binary_frame_raises_an_error(read: Callable[[bytes], None], content: bytes):
    read(content)
    for length in range(len(content)):
        with pytest.raises(FrameError):
            read(content[:length])


@pytest.mark.parametrize(
    ("request_frame", "message"),
    [
        (frames.step_request(1, np.ones((3, 1)), None, False), r"action: expected 16 bytes, shape \(2, 1\) of float64"),
        (frames.step_request(1, np.ones((2, 1)), np.ones(3, bool), False), "mask: expected 2 bytes"),
        (
            frames.StepRequest(action=np.ones(2).data, mask=memoryview(b"\x01\x02")),
            "mask: expected booleans as bytes of 0 or 1",
        ),
        (frames.rollout_request(1, np.ones((0, 2, 1))), "actions: expected 1 to 100000 steps of 2 x 1 float64"),
        (frames.rollout_request(1, np.ones(3)), "actions: expected 1 to 100000 steps of 2 x 1 float64, got 24 bytes"),
        (frames.reset_request(1, [1], None), "seed: expected 16 bytes"),
        (frames.reset_request(0, 1, None), "expected a binary frame"),
        (frames.reset_request(1, -1, None), "expected a binary frame"),
        (of_policy(steps=0), "expected a binary frame"),
        (of_policy(units=[1_025, 1]), "expected a binary frame"),
        (of_policy(units=[1] * 9), "expected a binary frame"),
        (of_policy(precision="float16"), "expected a binary frame"),
        (of_policy(units=[1_024] * 2), "policy: expected at most 262144 weights and biases, got 1053696"),
        (of_policy(units=[5, 1]), "parameters: expected 104 bytes"),
        (of_policy(mean=np.ones(4).data), "mean: expected 12 bytes"),
        (of_policy(deviation=np.zeros(3, dtype=np.float32).data), "expected numbers above 0 in deviation, got 0"),
        (of_policy(parameters=np.full(21, np.nan, dtype=np.float32).data), "finite numbers in layers"),
        (of_policy(until=np.ones(3, dtype=bool).data), "until: expected 2 bytes"),
        (of_policy(noise=frames.Noise(-1, 0)), "expected a binary frame"),
        (of_policy(noise=frames.Noise(0, 0, 0)), "expected a binary frame"),
    ],
)
def test_a_binary_request_that_does_not_fit_the_session_is_refused_with_the_reason(
    request_frame: frames.Request, message: str
):
    with pytest.raises(FrameError, match=message):
        read_whole_request(frames.encode(request_frame))


def test_a_binary_frame_with_an_unknown_field_is_refused():
    content = frames.encode(frames.reset_request(1, None, None))
    assert content[0] == 0x82, "a map of two"
    with pytest.raises(FrameError, match="unknown field `more`"):
        frames.read_request(b"\x83" + content[1:] + b"\xa4more\x01")


def test_a_rollout_reply_with_invalid_final_step_numbers_is_refused():
    reply = frames.policy_reply(1, policy_example())
    for wrong in (np.array([0, 2]), np.array([-1, 0]), np.array([1, 0]), np.array([0])):
        with pytest.raises(FrameError, match="final_steps: expected"):
            read_whole_reply(frames.encode(msgspec.structs.replace(reply, final_steps=wrong.data)))


def test_a_step_reply_with_invalid_final_environment_numbers_is_refused():
    step = frames.step_reply(1, example()).step
    for wrong in (np.array([2]), np.array([-1]), np.array([], dtype=np.int64)):
        other = frames.Step(**{f: getattr(step, f) for f in step.__struct_fields__} | {"final_lanes": wrong.data})
        with pytest.raises(FrameError, match=r"final_(lanes|observation): expected"):
            read_whole_reply(frames.encode(frames.StepReply(1, other)))


@pytest.mark.parametrize("seeds", [2**63, [2**63], [1.5, "a"], [None]])
def test_a_binary_reset_with_non_integer_seeds_is_refused(seeds: Any):
    with pytest.raises(FrameError, match="seed: expected whole numbers from 0 to"):
        frames.reset_request(1, seeds, None)
