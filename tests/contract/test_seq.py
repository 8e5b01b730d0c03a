"""A step happens once, on the wire itself: what a client that repeats, skips or races gets, byte for byte."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx
import pytest

N = 2
ACTION = [[0.5], [-1.0]]
Post = Callable[[str, dict[str, Any]], httpx.Response]


@pytest.fixture
def http(pendulum_server):
    with httpx.Client(base_url=pendulum_server.url, trust_env=False, timeout=150) as client:
        yield client


@pytest.fixture
def post(http: httpx.Client) -> Post:
    """Posts to a new session of two lanes that has been reset: its next seq is 2."""
    body = {"num_envs": N, "seed": 1, "time_limit": 50}
    session = http.post("/v1/surrogates/pendulum/sessions", json=body).json()["id"]

    def to_session(what: str, body: dict[str, Any]) -> httpx.Response:
        return http.post(f"/v1/sessions/{session}/{what}", json=body)

    assert to_session("reset", {"seq": 1}).json()["seq"] == 1
    return to_session


POLICY = {"mean": [0, 0, 0], "deviation": [1, 1, 8], "layers": [{"weights": [[1.0], [0.5], [2]], "bias": [0.1]}]}
REQUESTS = [
    ("step", {"seq": 2, "action": ACTION}),
    ("step", {"seq": 2, "action": ACTION, "mask": [True, False], "deviations": True}),
    ("reset", {"seq": 2, "seed": 4}),
    ("rollout", {"seq": 2, "actions": [ACTION] * 3}),
    ("rollout", {"seq": 2, "policy": {**POLICY, "log_deviations": [-1.0]}, "steps": 3, "noise": {"seed": 4}}),
]


@pytest.mark.parametrize(("what", "body"), REQUESTS)
def test_a_request_repeated_with_its_sequence_number_gets_the_same_bytes(post: Post, what: str, body: dict[str, Any]):
    first = post(what, body)
    assert first.status_code == 200
    assert post(what, body).content == first.content
    following = post("step", {"seq": 3, "action": ACTION})
    assert following.json()["seq"] == 3, "the repeat was no step of its own"


@pytest.mark.parametrize("seq", [1, 4, 1000])
def test_a_step_with_an_unexpected_sequence_number_is_refused_with_the_expected_one(post: Post, seq: int):
    post("step", {"seq": 2, "action": ACTION})
    refused = post("step", {"seq": seq, "action": ACTION})
    assert refused.status_code == 409
    assert (refused.json()["code"], refused.json()["expected_seq"]) == ("seq_conflict", 3)
    assert post("step", {"seq": 3, "action": ACTION}).json()["seq"] == 3


def test_another_request_with_a_used_sequence_number_is_refused(post: Post):
    first = post("step", {"seq": 2, "action": ACTION})
    for what, body in REQUESTS[1:]:
        refused = post(what, body)
        assert (refused.status_code, refused.json()["expected_seq"]) == (409, 3)
    assert post("step", {"seq": 2, "action": ACTION}).content == first.content, "the kept reply is still there"


def test_a_refused_request_does_not_use_its_sequence_number(post: Post):
    refused = post("step", {"seq": 2, "action": [[9.0], [0.0]]})
    assert (refused.status_code, refused.json()["code"]) == (422, "invalid_request")
    assert post("step", {"seq": 2, "action": ACTION}).status_code == 200


def test_concurrent_repeats_of_a_request_all_get_the_same_reply(post: Post):
    """Also while the first is still being computed: all of them step once."""
    body = {"seq": 2, "actions": [ACTION] * 200}
    with ThreadPoolExecutor(4) as pool:
        replies = list(pool.map(lambda _: post("rollout", body).content, range(4)))
    assert len(set(replies)) == 1
    assert post("step", {"seq": 3, "action": ACTION}).status_code == 200


def test_a_step_without_sequence_number_takes_the_next_one(post: Post):
    assert post("step", {"action": ACTION}).json()["seq"] == 2
    assert post("step", {"action": ACTION}).json()["seq"] == 3
    assert post("step", {"seq": 4, "action": ACTION}).json()["seq"] == 4
