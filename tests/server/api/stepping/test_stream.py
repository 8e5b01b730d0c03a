"""The stream and the binary bodies: the same frames, the same laws as JSON, and repeats that change their transport."""

from __future__ import annotations

import asyncio
import signal
import socket
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlsplit

import httpx
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.frames import Frame, Opcode
from websockets.sync.client import ClientConnection, connect

from support import pendulum
from support.server import ServerProcess, start_server
from surrogym_server.api.door import Gate
from surrogym_server.api.stepping.stream import StepStream
from surrogym_shared import frames, wire
from surrogym_shared.codes import Code, Problem
from surrogym_shared.messages import MASKED, WHOLE_BINARY, FrameSplitter, header

SHAPE = frames.Shape(lanes=2, observation=3, action=1, outputs=3)
ACTION = np.array([[0.5], [-1.5]])
BINARY = {"content-type": frames.MEDIA_TYPE}
Exchange = Callable[[frames.Request], frames.Reply]


def address(url: str, session: str) -> str:
    return f"{url.replace('http', 'ws', 1)}/v1/sessions/{session}/stream"


@pytest.fixture
def stream(server_process: ServerProcess, session: str) -> Iterator[ClientConnection]:
    with connect(address(server_process.url, session), compression=None) as connection:
        yield connection


def over_stream(stream: ClientConnection) -> Exchange:
    def exchange(request: frames.Request) -> frames.Reply:
        stream.send(frames.encode(request))
        content = stream.recv(timeout=60)
        assert isinstance(content, bytes)
        return frames.read_reply(content)

    return exchange


def post(client: httpx.Client, session: str, request: frames.Request, what: str | None = None) -> httpx.Response:
    what = what or type(request).__struct_config__.tag
    return client.post(f"/v1/sessions/{session}/{what}", content=frames.encode(request), headers=BINARY)


def over_http(client: httpx.Client, session: str) -> Exchange:
    return lambda request: frames.read_reply(post(client, session, request).raise_for_status().content)


REQUESTS = [
    frames.reset_request(1, 5, None),
    frames.step_request(2, ACTION, np.array([True, False]), True),
    frames.rollout_request(3, np.stack([ACTION, ACTION])),
]
AS_JSON: list[tuple[str, dict[str, Any]]] = [
    ("reset", {"seq": 1, "seed": 5}),
    ("step", {"seq": 2, "action": ACTION.tolist(), "mask": [True, False], "deviations": True}),
    ("rollout", {"seq": 3, "actions": [ACTION[:, 0].tolist()] * 2}),
]


def test_a_repeated_request_gets_the_same_reply_over_another_transport(
    client: httpx.Client, session: str, stream: ClientConnection
):
    """One session goes through three requests, each repeated over all transports: one reply each, bit for bit."""
    first: list[Callable[[int], bytes]] = [
        lambda i: frames.encode(over_stream(stream)(REQUESTS[i])),
        lambda i: post(client, session, REQUESTS[i]).raise_for_status().content,
        lambda i: json_as_frame(client, session, *AS_JSON[i]),
    ]
    for i in range(len(REQUESTS)):
        assert len({transport(i) for transport in first}) == 1
        first.append(first.pop(0))
    assert client.get(f"/v1/sessions/{session}").json()["seq"] == 3


def json_as_frame(client: httpx.Client, session: str, what: str, body: dict[str, Any]) -> bytes:
    reply = client.post(f"/v1/sessions/{session}/{what}", json=body).raise_for_status().json()
    if what == "reset":
        result = frames.ResetResult(np.array(reply["observation"]), np.array(reply["model_version"]))
        return frames.encode(frames.reset_reply(reply["seq"], result))
    steps = [reply] if what == "step" else reply["steps"]
    results = [frames.StepResult(**{k: listed(v) for k, v in step.items() if k != "seq"}) for step in steps]
    if what == "step":
        return frames.encode(frames.step_reply(reply["seq"], results[0]))
    return frames.encode(frames.rollout_reply(reply["seq"], results))


def listed(value: Any) -> Any:
    return None if value is None else np.array(value)


def test_per_environment_seeds_have_the_same_effect_over_every_transport(client: httpx.Client, session: str):
    seeds, mask = [2**63 - 1, 0], np.array([True, False])
    client.post(f"/v1/sessions/{session}/reset", json={"seq": 1}).raise_for_status()
    framed = over_http(client, session)(frames.reset_request(2, seeds, mask))
    body = {"seq": 2, "seed": seeds, "mask": mask.tolist()}
    again = client.post(f"/v1/sessions/{session}/reset", json=body).raise_for_status().json()
    assert isinstance(framed, frames.ResetReply)
    np.testing.assert_array_equal(frames.reset_result(framed, SHAPE).observation, np.float32(again["observation"]))


def test_the_stream_continues_after_an_error_reply(stream: ClientConnection):
    exchange = over_stream(stream)
    refused = exchange(frames.step_request(1, ACTION, None, False))
    assert isinstance(refused, frames.ProblemReply)
    assert (refused.code, refused.status, refused.seq) == (Code.NOT_RESET, 409, 1)
    assert isinstance(exchange(frames.reset_request(1, None, None)), frames.ResetReply)
    ahead = exchange(frames.step_request(7, ACTION, None, False))
    assert isinstance(ahead, frames.ProblemReply)
    assert (ahead.code, ahead.expected_seq, ahead.seq) == (Code.SEQ_CONFLICT, 2, 7)
    step = exchange(frames.step_request(2, ACTION, None, False))
    assert isinstance(step, frames.StepReply)
    assert frames.step_result(step.step, SHAPE).reward.shape == (2,)


BAD: list[tuple[bytes, str]] = [
    (b"no frame", "expected a binary frame (msgpack), got 8 bytes that can't be read as one"),
    (b"", "expected a binary frame (msgpack), got 0 bytes"),
    (frames.encode(frames.step_request(2, np.ones((3, 1)), None, False)), "action: expected 16 bytes"),
    (frames.encode(frames.step_request(2, ACTION, np.ones(3, bool), False)), "mask: expected 2 bytes"),
    (frames.encode(frames.step_request(2, ACTION * np.nan, None, False)), "expected finite numbers"),
    (frames.encode(frames.step_request(2, ACTION * 1e9, None, False)), "expected entry 0 in [-2, 2]"),
]


@pytest.mark.parametrize(("content", "said"), BAD)
def test_an_invalid_frame_is_refused_and_the_session_is_unchanged(
    client: httpx.Client, session: str, stream: ClientConnection, content: bytes, said: str
):
    over_stream(stream)(frames.reset_request(1, None, None))
    stream.send(content)
    problem = frames.read_reply(stream.recv(timeout=60))
    assert isinstance(problem, frames.ProblemReply)
    assert (problem.code, problem.status) == (Code.INVALID_REQUEST, 422)
    assert said in problem.detail
    reply = client.post(f"/v1/sessions/{session}/step", content=content, headers=BINARY)
    assert Problem.model_validate_json(reply.content).detail == problem.detail
    assert (reply.status_code, reply.headers["content-type"]) == (422, "application/problem+json")
    assert client.get(f"/v1/sessions/{session}").json()["seq"] == 1


def test_a_text_message_on_the_stream_is_refused(stream: ClientConnection):
    stream.send('{"op": "reset"}')
    problem = frames.read_reply(stream.recv(timeout=60))
    assert isinstance(problem, frames.ProblemReply)
    assert problem.detail == "expected a request as a binary message (a frame), got a text message: send a frame"


def test_a_reset_frame_sent_to_the_step_route_is_refused(client: httpx.Client, session: str):
    reply = post(client, session, frames.reset_request(1, None, None), what="step")
    assert (reply.status_code, reply.json()["detail"]) == (
        422,
        "expected a frame of the operation step, got one of reset: send it to the address of its operation",
    )


def test_a_step_with_an_unknown_content_type_is_refused(client: httpx.Client, session: str):
    reply = client.post(f"/v1/sessions/{session}/step", content=b"1", headers={"content-type": "text/csv"})
    assert reply.json()["code"] == "unsupported_media_type"
    assert "application/json or application/vnd.msgpack, got text/csv" in reply.json()["detail"]


def test_opening_a_stream_of_an_unknown_session_is_refused(server_process: ServerProcess):
    with pytest.raises(InvalidStatus) as refused, connect(address(server_process.url, "none")):
        pass
    problem = Problem.model_validate_json(refused.value.response.body)
    assert (problem.code, refused.value.response.status_code) == (Code.UNKNOWN_SESSION, 404)


def test_a_request_on_the_stream_of_a_closed_session_gets_an_error_reply(
    client: httpx.Client, session: str, stream: ClientConnection
):
    client.delete(f"/v1/sessions/{session}")
    problem = over_stream(stream)(frames.reset_request(1, None, None))
    assert isinstance(problem, frames.ProblemReply)
    assert problem.code is Code.UNKNOWN_SESSION


def test_many_messages_sent_at_once_do_not_block_other_clients():
    """Messages that are all there at once are answered with other work in between."""
    waiting, answered, turns = 200, 0, 0
    action = SimpleNamespace(size=1)
    definition = SimpleNamespace(observation_names=("x",), action=action, outputs=("x", "reward"))
    session = SimpleNamespace(definition=definition, settings=SimpleNamespace(num_envs=1))

    async def describe(_: str) -> Any:
        return session

    services = SimpleNamespace(engine=SimpleNamespace(describe=describe))
    app = SimpleNamespace(state=SimpleNamespace(gate=Gate({})))
    scope = {"state": {"services": services}, "app": app, "path_params": {"id": "s"}, "headers": []}
    messages = iter([{"type": "websocket.connect"}, *[{"type": "websocket.receive", "text": "x"}] * waiting])

    async def receive() -> dict[str, Any]:
        return next(messages, {"type": "websocket.disconnect"})

    async def send(message: Any) -> None:
        nonlocal answered
        answered += message["type"] == "websocket.send"

    async def other() -> None:
        nonlocal turns
        while answered < waiting:
            turns += 1
            await asyncio.sleep(0)

    async def both() -> None:
        await asyncio.gather(StepStream()(scope, receive, send), other())

    asyncio.run(both())
    assert turns >= waiting - 1


def test_the_same_request_over_several_streams_of_a_session_steps_once(server_process: ServerProcess, session: str):
    def run(_: int) -> bytes:
        with connect(address(server_process.url, session), compression=None) as stream:
            return frames.encode(over_stream(stream)(frames.rollout_request(2, np.stack([ACTION] * 200))))

    with connect(address(server_process.url, session)) as stream:
        over_stream(stream)(frames.reset_request(1, None, None))
    with ThreadPoolExecutor(3) as pool:
        assert len(set(pool.map(run, range(3)))) == 1


def test_a_stream_opened_by_a_page_of_another_origin_is_refused(server_process: ServerProcess, session: str):
    url = address(server_process.url, session)
    with connect(url, origin=server_process.url) as own:  # type: ignore[arg-type]
        assert isinstance(over_stream(own)(frames.reset_request(1, None, None)), frames.ResetReply)
    with pytest.raises(InvalidStatus) as refused, connect(url, origin="http://elsewhere.example"):  # type: ignore[arg-type]
        pass
    assert refused.value.response.status_code == 403
    assert b"elsewhere.example" in refused.value.response.body


def test_an_oversized_message_or_a_server_shutdown_closes_the_stream(tmp_path: Path):
    server = start_server(tmp_path, SURROGYM_MAX_BODY_BYTES="2048")
    try:
        with httpx.Client(base_url=server.url, timeout=60) as client:
            pendulum.teach(client, "p")
            session = client.post("/v1/surrogates/p/sessions", json=wire.OpenSession(num_envs=2).model_dump()).json()
            with connect(address(server.url, session["id"]), compression=None) as stream:
                stream.send(b"\0" * 4096)
                with pytest.raises(ConnectionClosed) as closed:
                    stream.recv(timeout=60)
            assert closed.value.rcvd is not None
            assert closed.value.rcvd.code == 1009
            with connect(address(server.url, session["id"]), compression=None) as stream:
                over_stream(stream)(frames.reset_request(1, None, None))
                assert server.stop(signal.SIGTERM) == 0, "an open stream holds no shutdown up"
                with pytest.raises(ConnectionClosed) as closed:
                    stream.recv(timeout=60)
            assert closed.value.rcvd is not None
            assert closed.value.rcvd.code == 1012
    finally:
        server.stop(signal.SIGKILL)


def test_the_deadline_header_of_a_stream_applies_to_each_message(
    server_process: ServerProcess, client: httpx.Client, session: str
):
    client.post(f"/v1/sessions/{session}/reset", json={}).raise_for_status()
    client.post(f"/v1/sessions/{session}/step", json={"action": ACTION.tolist()}).raise_for_status()
    headers = {"x-deadline-ms": "20"}
    with connect(address(server_process.url, session), compression=None, additional_headers=headers) as stream:
        late = over_stream(stream)(frames.rollout_request(None, np.stack([ACTION] * 2_000)))
        assert isinstance(late, frames.ProblemReply)
        assert (late.status, late.code) == (503, Code.DEADLINE_EXCEEDED)
    with pytest.raises(InvalidStatus) as refusal:
        connect(address(server_process.url, session), additional_headers={"x-deadline-ms": "0"})
    assert refusal.value.response.status_code == 422


@pytest.fixture
def bare(server_process: ServerProcess, session: str) -> Iterator[socket.socket]:
    """A stream whose bytes are written by hand."""
    parts = urlsplit(server_process.url)
    with socket.create_connection((parts.hostname, parts.port), 30) as connected:
        lines = [f"GET /v1/sessions/{session}/stream HTTP/1.1", f"Host: {parts.netloc}", "Upgrade: websocket"]
        lines += ["Connection: Upgrade", "Sec-WebSocket-Version: 13", "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA=="]
        connected.sendall("\r\n".join([*lines, "", ""]).encode())
        answer = b""
        while b"\r\n\r\n" not in answer:
            answer += connected.recv(4_096)
        assert b" 101 " in answer
        yield connected


def written(request: frames.Request) -> bytes:
    return Frame(Opcode.BINARY, frames.encode(request)).serialize(mask=True, extensions=[])


def replies(connected: socket.socket, count: int) -> list[Any]:
    splitter, found = FrameSplitter(), []
    while len(found) < count:
        found += splitter.split(connected.recv(65_536))
    return [frames.read_reply(frame[extent.payload :]) for frame, extent in found if frame[0] == WHOLE_BINARY]


def test_fragmented_and_joined_websocket_messages_are_answered_in_order(bare: socket.socket):
    """Alone, byte by byte, several in one piece with a ping between, and as fragments."""
    bare.sendall(written(frames.reset_request(1, 0, None)))
    (first,) = replies(bare, 1)
    for byte in written(frames.step_request(2, ACTION, None, False)):
        bare.sendall(bytes([byte]))
    (second,) = replies(bare, 1)
    third, fourth = (written(frames.step_request(seq, ACTION, None, False)) for seq in (3, 4))
    bare.sendall(third + Frame(Opcode.PING, b"?").serialize(mask=True, extensions=[]) + fourth)
    ahead = replies(bare, 3)
    content = frames.encode(frames.step_request(5, ACTION, None, False))
    begin = Frame(Opcode.BINARY, content[:9], fin=False).serialize(mask=True, extensions=[])
    bare.sendall(begin + Frame(Opcode.CONT, content[9:]).serialize(mask=True, extensions=[]))
    (fifth,) = replies(bare, 1)
    bare.sendall(written(frames.step_request(6, ACTION, None, False)))
    (sixth,) = replies(bare, 1)
    assert [r.seq for r in (first, second, *ahead, fifth, sixth)] == [1, 2, 3, 4, 5, 6]


def test_a_message_whose_announced_length_exceeds_the_limit_closes_the_stream(bare: socket.socket):
    bare.sendall(written(frames.reset_request(1, 0, None)))
    replies(bare, 1)
    bare.sendall(header(2**40, MASKED) + b"key!" + b"some")
    answer = b""
    while piece := bare.recv(4_096):
        answer += piece
    assert answer[2:4] == (1009).to_bytes(2, "big")
