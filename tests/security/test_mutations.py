"""Mutated bodies and frames on every route that takes numbers: refused in words, no crash, no memory kept."""

from __future__ import annotations

import json
import random
from collections.abc import Callable, Iterator

import httpx
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from support import pendulum
from support.chaos import SEED, times
from support.hostile import mutated, resident_mib, upgraded
from support.server import ServerProcess
from surrogym_shared import frames
from surrogym_shared.codes import PROBLEM_MEDIA_TYPE, Problem

MUTATIONS = times(short=250, full=17_000)  # of each of six kinds
WARM, GROWTH_MIB = 50, 24.0
ACTION = np.array([[0.5], [-1.5]])

pytestmark = pytest.mark.timeout(3_600)


@pytest.fixture
def server(pendulum_server: ServerProcess) -> ServerProcess:
    """Nothing that is thrown at it may harm what other tests do there."""
    return pendulum_server


@pytest.fixture
def client(server: ServerProcess) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=server.url, timeout=60) as client:
        yield client


@pytest.fixture
def session(client: httpx.Client) -> Iterator[str]:
    """A session of two lanes that has been reset."""
    opened = client.post("/v1/surrogates/pendulum/sessions", json={"seed": 0, "num_envs": 2}).raise_for_status()
    id: str = opened.json()["id"]
    client.post(f"/v1/sessions/{id}/reset", json={}).raise_for_status()
    yield id
    client.delete(f"/v1/sessions/{id}").raise_for_status()


def attack(server: ServerProcess, send: Callable[[bytes], None], content: bytes, seed: int) -> None:
    """Send so many mutations, then ask how the server is."""
    source, before = random.Random(SEED + seed), 0.0
    for number in range(MUTATIONS):
        if number == WARM:
            before = resident_mib(server.process.pid)
        send(mutated(source, content))
    assert resident_mib(server.process.pid) < before + GROWTH_MIB
    assert server.process.poll() is None
    assert "Traceback" not in server.log


def posting(client: httpx.Client, path: str, media_type: str) -> Callable[[bytes], None]:
    def send(content: bytes) -> None:
        reply = client.post(path, content=content, headers={"content-type": media_type})
        assert reply.status_code < 500, (content, reply.text)
        if reply.is_error:
            assert reply.headers["content-type"] == PROBLEM_MEDIA_TYPE
            assert Problem.model_validate_json(reply.content).detail

    return send


BODIES = [
    ("step", {"action": ACTION.tolist(), "mask": [True, True], "deviations": True}),
    ("reset", {"seed": [1, 2], "mask": [True, True]}),
]
FRAMES = [frames.step_request(None, ACTION, None, True), frames.reset_request(None, [1, 2], None)]


@pytest.mark.parametrize(("what", "body"), BODIES)
def test_mutated_json_requests_of_sessions_are_refused_without_a_crash(
    server: ServerProcess, client: httpx.Client, session: str, what: str, body: object
):
    send = posting(client, f"/v1/sessions/{session}/{what}", "application/json")
    attack(server, send, json.dumps(body).encode(), seed=1)


@pytest.mark.parametrize("frame", FRAMES, ids=["step", "reset"])
def test_mutated_binary_requests_of_sessions_are_refused_without_a_crash(
    server: ServerProcess, client: httpx.Client, session: str, frame: frames.Request
):
    what = type(frame).__struct_config__.tag
    send = posting(client, f"/v1/sessions/{session}/{what}", frames.MEDIA_TYPE)
    attack(server, send, frames.encode(frame), seed=2)


def test_mutated_samples_are_refused_without_a_crash(server: ServerProcess, client: httpx.Client):
    client.post("/v1/surrogates", json={"name": "open", "spec": pendulum.spec(initial=200, budget=300)})
    query = pendulum.claim(client, "open", max_queries=1)["queries"][0]
    body = {"sampler": "hostile", "samples": [pendulum.answer(query)]}
    send = posting(client, "/v1/surrogates/open/add_sample", "application/json")
    attack(server, send, json.dumps(body).encode(), seed=3)
    view = client.get("/v1/surrogates/open").raise_for_status().json()
    assert view["phase"] == "collecting", "what got through was a sample, and no more"
    client.delete("/v1/surrogates/open").raise_for_status()


def test_mutated_stream_messages_are_refused_and_the_stream_continues(
    server: ServerProcess, client: httpx.Client, session: str
):
    """A refused message leaves its connection open; the one after it is answered."""
    address = f"{server.url.replace('http', 'ws', 1)}/v1/sessions/{session}/stream"
    good = frames.encode(FRAMES[0])
    with connect(address, compression=None, open_timeout=60) as stream:

        def send(content: bytes) -> None:
            stream.send(content)
            reply = frames.read_reply(bytes(stream.recv(timeout=60)))
            assert not isinstance(reply, frames.ProblemReply) or reply.status < 500

        try:
            attack(server, send, good, seed=4)
        except ConnectionClosed as closed:
            raise AssertionError("the stream was closed") from closed
        stream.send(good)
        assert isinstance(frames.read_reply(bytes(stream.recv(timeout=60))), frames.StepReply)


def websocket_frames(source: random.Random) -> bytes:
    """Frames with any opcode, whole or not, or bytes that are none."""
    if source.random() < 0.4:
        return source.randbytes(source.randint(1, 60))
    content = source.randbytes(source.randint(0, 50))
    head = bytes([source.randrange(2) << 7 | source.randrange(16), 0x80 | len(content)])
    return (head + bytes(4) + content) * source.randint(1, 4)


def test_random_websocket_frames_cause_no_server_error(server: ServerProcess, session: str):
    source, stream = random.Random(SEED), upgraded(server.url, session)
    for _ in range(MUTATIONS):
        try:
            stream.sendall(websocket_frames(source))
            if source.random() < 0.3:
                stream.settimeout(0.005)
                stream.recv(65_536)
        except OSError:
            stream.close()
            stream = upgraded(server.url, session)
    stream.close()
    assert server.process.poll() is None
    assert "Traceback" not in server.log
    assert "ERROR" not in server.log
