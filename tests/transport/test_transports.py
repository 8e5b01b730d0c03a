"""Which transport a step takes: the stream where it gets through, HTTP where it does not, and for repeats."""

from __future__ import annotations

import pickle
from http.server import BaseHTTPRequestHandler

import numpy as np
import pytest

from support.scripted_server import Answer, ScriptedServer, problem, reply, scripted_server, session_view, upgrade
from surrogym_client import errors
from surrogym_client.transport import HttpSurrogate
from surrogym_client.transport.connection import Connection, Retries, Timeouts
from surrogym_shared import frames, wire
from surrogym_shared.codes import Code
from surrogym_shared.messages import KEY_BYTES, header
from surrogym_shared.port import StepResult

QUICK = Retries(seconds=2.0, first_delay=0.01, longest_delay=0.05)
ACTION = np.array([[0.5], [-0.5]])


def step(seq: int) -> Answer:
    return binary(step_frame(seq))


def step_frame(seq: int) -> bytes:
    result = StepResult(
        observation=np.zeros((2, 2), dtype=np.float32),
        reward=np.full(2, float(seq)),
        terminated=np.zeros(2, dtype=bool),
        truncated=np.zeros(2, dtype=bool),
        final_lanes=np.zeros(0, dtype=np.int64),
        final_observation=np.zeros((0, 2), dtype=np.float32),
        model_version=np.ones(2, dtype=np.int64),
        reward_mean=np.zeros(2),
        deviation=None,
    )
    return frames.encode(frames.step_reply(seq, result))


def binary(content: bytes) -> Answer:
    def answer(handler: BaseHTTPRequestHandler) -> None:
        handler.send_response(200)
        handler.send_header("Content-Type", frames.MEDIA_TYPE)
        handler.send_header("Content-Length", str(len(content)))
        handler.end_headers()
        handler.wfile.write(content)

    return answer


def upgrade_and_cut(handler: BaseHTTPRequestHandler) -> None:
    """Accept the stream, take one message, and cut the connection."""
    upgrade(handler)
    handler.rfile.read(2)
    handler.close_connection = True


def upgrade_and_swallow(handler: BaseHTTPRequestHandler) -> None:
    """Accept the stream, and never answer what comes."""
    upgrade(handler)
    handler.rfile.read()
    handler.close_connection = True


def upgrade_answer_and_cut(reply: bytes) -> Answer:
    """Accept the stream, answer its first message, take another, and cut the connection."""

    def answer(handler: BaseHTTPRequestHandler) -> None:
        upgrade(handler)
        size = handler.rfile.read(2)[1] & 0x7F
        handler.rfile.read(KEY_BYTES + size)
        handler.wfile.write(header(len(reply)) + reply)
        handler.rfile.read(2)
        handler.close_connection = True

    return answer


def calls(server: ScriptedServer) -> list[tuple[str, str]]:
    """Method and last part of the path, after the opening."""
    return [(r.method, r.path.rpartition("/")[2]) for r in server.received[1:]]


def seqs(server: ScriptedServer) -> list[int | None]:
    return [frames.read_request(r.body).seq for r in server.received[1:] if r.method == "POST"]


REFUSALS = [reply("<html>", 426, "text/html"), problem(Code.NOT_FOUND), reply("<html>", 502, "text/html")]


@pytest.mark.parametrize("refusal", REFUSALS)
def test_if_the_stream_upgrade_is_refused_binary_http_is_used(refusal: Answer):
    with (
        scripted_server(session_view(), refusal, step(1), step(2)) as server,
        HttpSurrogate(server.url, "pendulum", retries=QUICK) as port,
    ):
        port.open(wire.OpenSession(num_envs=2))
        assert [port.step("abc", ACTION).reward[0] for _ in range(2)] == [1.0, 2.0]
        assert calls(server) == [("GET", "stream"), ("POST", "step"), ("POST", "step")], "not asked for again at once"
        assert server.received[-1].headers["Content-Type"] == frames.MEDIA_TYPE
        assert seqs(server) == [1, 2]


def test_a_step_lost_with_its_stream_is_repeated_by_http_with_its_sequence_number():
    script = [session_view(), upgrade_answer_and_cut(step_frame(1)), step(2), upgrade_and_cut, step(3)]
    with scripted_server(*script) as server, HttpSurrogate(server.url, "pendulum", retries=QUICK) as port:
        port.open(wire.OpenSession(num_envs=2))
        assert [port.step("abc", ACTION).reward[0] for _ in range(3)] == [1.0, 2.0, 3.0]
        assert calls(server) == [("GET", "stream"), ("POST", "step")] * 2, "the next step asks for a stream again"
        assert seqs(server) == [2, 3]


def test_opening_a_session_has_a_longer_timeout_than_other_requests():
    with scripted_server(session_view(delay=0.6)) as server:
        hasty = Timeouts(request=0.2)
        with HttpSurrogate(server.url, "pendulum", retries=Retries(seconds=0), timeouts=hasty) as port:
            assert port.open(wire.OpenSession(num_envs=2)).id == "abc"


@pytest.mark.parametrize("useless", [upgrade_and_cut, upgrade_and_swallow])
def test_a_stream_that_never_answers_is_replaced_by_http(useless: Answer):
    script = [session_view(), useless, step(1), step(2)]
    hasty = Timeouts(step=0.3)
    with (
        scripted_server(*script) as server,
        HttpSurrogate(server.url, "pendulum", retries=QUICK, timeouts=hasty) as port,
    ):
        port.open(wire.OpenSession(num_envs=2))
        assert [port.step("abc", ACTION).reward[0] for _ in range(2)] == [1.0, 2.0]
        assert calls(server) == [("GET", "stream"), ("POST", "step"), ("POST", "step")], "each step would wait again"
        assert seqs(server) == [1, 2]


def test_with_transport_stream_only_the_stream_is_retried_and_then_fails():
    with (
        scripted_server(session_view(), reply("<html>", 426, "text/html")) as server,
        HttpSurrogate(server.url, "pendulum", retries=Retries(seconds=0.2), transport="stream") as port,
    ):
        port.open(wire.OpenSession(num_envs=2))
        with pytest.raises(errors.ServerUnreachable, match="refused with status 426"):
            port.step("abc", ACTION)
        assert len(calls(server)) > 1
        assert set(calls(server)) == {("GET", "stream")}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"no frame", "/v1/sessions/abc/step .*: expected a binary frame"),
        (
            frames.encode(frames.ResetReply(1, memoryview(b""), memoryview(b""))),
            "expected a reply of the type StepReply, got ResetReply",
        ),
    ],
)
def test_a_binary_reply_that_is_not_a_step_is_refused(content: bytes, message: str):
    with (
        scripted_server(session_view(), binary(content)) as server,
        HttpSurrogate(server.url, "pendulum", transport="binary") as port,
    ):
        port.open(wire.OpenSession(num_envs=2))
        with pytest.raises(errors.ProtocolMismatch, match=message):
            port.step("abc", ACTION)


def test_a_reply_to_another_request_is_refused():
    with (
        scripted_server(session_view(), step(7)) as server,
        HttpSurrogate(server.url, "pendulum", transport="binary") as port,
    ):
        port.open(wire.OpenSession(num_envs=2))
        with pytest.raises(
            errors.ProtocolMismatch, match="expected the answer to request 1 of session abc, got the one to request 7"
        ):
            port.step("abc", ACTION)


@pytest.mark.parametrize(
    ("action", "mask", "message"),
    [
        (np.zeros((3, 1)), None, r"action: expected shape \(2, 1\), got \(3, 1\)"),
        (np.zeros((1, 2)), None, r"action: expected shape \(2, 1\), got \(1, 2\)"),
        (np.array([["left"], ["right"]]), None, r"expected an array of numbers, got dtype <U5"),
        (ACTION, np.ones(3, dtype=bool), r"mask: expected shape \(2,\), got \(3,\)"),
    ],
)
def test_invalid_values_are_refused_before_binary_encoding(action, mask, message: str):
    with scripted_server(session_view()) as server, HttpSurrogate(server.url, "pendulum", transport="binary") as port:
        port.open(wire.OpenSession(num_envs=2))
        with pytest.raises(errors.InvalidInput, match=message):
            port.step("abc", action, mask=mask)
        assert len(server.received) == 1


def test_the_client_accepts_exactly_four_transport_names():
    with pytest.raises(ValueError, match="expected one of auto, stream, binary, json, got 'grpc'"):
        HttpSurrogate(None, "pendulum", transport="grpc")  # type: ignore[arg-type]


def test_the_default_transport_uses_the_stream(pendulum_server):
    """No step goes by HTTP: the client's pool has seen none since the session was opened."""
    with HttpSurrogate(pendulum_server.url, "pendulum") as port:
        session = port.open(wire.OpenSession(num_envs=2)).id
        port.connection.close()
        port.reset(session)
        port.step(session, ACTION)
        assert port.connection._client.is_closed
        copy = pickle.loads(pickle.dumps(port))
        assert copy.step(session, ACTION).reward.shape == (2,)
        assert not copy.connection._client._transport._pool.connections
        copy.disconnect()
        with pytest.raises(errors.SeqConflict):
            port.step(session, -ACTION)
        port.close(session)


def test_no_stream_is_opened_if_a_proxy_is_configured(monkeypatch: pytest.MonkeyPatch):
    for name in ("http_proxy", "HTTP_PROXY", "no_proxy", "NO_PROXY"):
        monkeypatch.delenv(name, raising=False)
    assert not Connection("http://far.example").proxied
    monkeypatch.setenv("http_proxy", "http://proxy.example:3128")
    assert Connection("http://far.example").proxied
    assert not Connection("https://far.example").proxied
    assert not Connection("http://127.0.0.1:8000").proxied
    monkeypatch.setenv("no_proxy", "far.example")
    assert not Connection("http://far.example").proxied
