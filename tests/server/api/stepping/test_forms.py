"""Replies to rollouts: a long one is written in a thread of its own, and says what a short one says."""

from __future__ import annotations

import asyncio
import threading
from typing import cast

import msgspec
import numpy as np
import pytest

from support.acting import assert_same_rollout, random_policy
from surrogym_client.transport.step_codecs import BinaryForm, JsonForm
from surrogym_server.api.stepping import forms
from surrogym_server.convert import sessions
from surrogym_server.engine.port import SessionEngine
from surrogym_server.engine.requests import Advance, PolicySteps, Reply, Rollout
from surrogym_shared import frames, wire
from surrogym_shared.acting import PolicyRun
from surrogym_shared.port import PolicyRollout, StepResult

SHAPE = frames.Shape(lanes=2, observation=3, action=1, outputs=3)


def step(number: int) -> StepResult:
    return StepResult(
        observation=np.full((2, 3), number, dtype=np.float32),
        reward=np.array([number, -0.5]),
        terminated=np.zeros(2, dtype=bool),
        truncated=np.ones(2, dtype=bool),
        final_lanes=np.array([1]),
        final_observation=np.zeros((1, 3), dtype=np.float32),
        model_version=np.ones(2, dtype=np.int64),
        reward_mean=np.zeros(2),
        deviation=None,
    )


class Prepared:
    """Answers a rollout of T steps with as many, all different."""

    async def advance(self, request: Advance) -> Reply:
        if isinstance(request, Rollout):
            return Reply(7, tuple(step(number) for number in range(len(request.actions))))
        assert isinstance(request, PolicySteps)
        steps = request.run.steps
        results = [step(number) for number in range(steps)]
        return Reply(7, PolicyRollout.of(results, np.ones((steps, 2, 1)), None))


ENGINE = cast(SessionEngine, Prepared())


def in_json(content: bytes) -> bytes:
    request = forms.request_in_json("rollout", "abc", content, None)
    return asyncio.run(forms.carried_out(ENGINE, request, forms.AS_JSON))


def in_frame(frame: frames.Request) -> bytes:
    return asyncio.run(forms.carried_out(ENGINE, forms.request_in_frame(frame, "abc", SHAPE), forms.AS_FRAME))


@pytest.fixture
def writers(monkeypatch: pytest.MonkeyPatch) -> set[threading.Thread]:
    """The threads that replies are written in."""
    seen: set[threading.Thread] = set()
    for name in ("rollout_frame", "rollout_steps"):
        write = getattr(sessions, name)
        monkeypatch.setattr(
            sessions, name, lambda answer, write=write: seen.add(threading.current_thread()) or write(answer)
        )
    return seen


@pytest.mark.parametrize("steps", [1, forms.SHORT_ROLLOUT, forms.SHORT_ROLLOUT + 1, 200])
def test_long_rollout_replies_are_serialised_in_a_thread_and_short_ones_are_not(
    steps: int, writers: set[threading.Thread]
):
    actions = np.zeros((steps, 2, 1))
    as_json = in_json(msgspec.json.encode({"actions": actions.tolist()}))
    as_frame = in_frame(frames.rollout_request(None, actions))
    assert (threading.main_thread() in writers) == (steps <= forms.SHORT_ROLLOUT), "nobody else is answered meanwhile"
    reply, frame = wire.RolloutReply.model_validate_json(as_json), frames.read_reply(as_frame)
    assert isinstance(frame, frames.RolloutReply)
    assert reply.seq == frame.seq == 7
    assert [one.reward for one in reply.steps] == [[number, -0.5] for number in range(steps)]
    assert {one.seq for one in reply.steps} == {7}
    assert [frames.step_result(one, SHAPE).reward.tolist() for one in frame.steps] == [
        one.reward for one in reply.steps
    ]


@pytest.mark.parametrize("steps", [1, forms.SHORT_ROLLOUT + 1])
def test_a_policy_rollout_reply_is_equal_as_json_and_as_binary_frame(steps: int, writers: set[threading.Thread]):
    run = PolicyRun(random_policy((3, 4, 1)), steps)
    as_json = in_json(JsonForm().policy(1, run, SHAPE))
    as_frame = in_frame(frames.policy_request(None, run.policy, steps, None, None))
    assert (threading.main_thread() in writers) == (steps <= forms.SHORT_ROLLOUT)
    assert wire.RolloutReply.model_validate_json(as_json).action == [[[1.0], [1.0]]] * steps
    (seq, ours), (_, theirs) = JsonForm().read_policy(as_json, SHAPE), BinaryForm().read_policy(as_frame, SHAPE)
    assert seq == 7
    assert_same_rollout(ours, theirs)
