"""Too much, too slow, too many: refused in words before it costs anything, and others are served meanwhile."""

from __future__ import annotations

import contextlib
import resource
import socket
import statistics
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import numpy as np
import pytest
from websockets.sync.client import connect

from support import pendulum as wire_pendulum
from support.chaos import times
from support.hostile import KEY, connected, head, read_all, resident_mib, upgraded
from support.server import ServerProcess, running_server
from support.teaching import teach
from surrogym_client.transport import Api
from surrogym_sampler.original.classic import pendulum
from surrogym_shared import frames
from surrogym_shared.codes import Code, Problem

GIGABYTE = 10**9
REQUEST_SECONDS, MEMORY_MIB, BODY_MIB = 4, 64, 32
IDLE = times(short=300, full=10_000)
SLOWER = 10.0  # a step beside an attack, in those before it; a queue behind it would be hundreds
ACTION = {"action": [[0.5]]}
PATH, JSON_BYTES, ALL_BYTES = "/v1/surrogates/pendulum/add_sample", 1024 * 1024, 128 * 1024

pytestmark = pytest.mark.timeout(900)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServerProcess]:
    limits = {"SURROGYM_REQUEST_SECONDS": str(REQUEST_SECONDS), "SURROGYM_MAX_SESSIONS_MIB": str(MEMORY_MIB)}
    with running_server(tmp_path_factory.mktemp("overload"), **limits) as server:
        with Api(server.url) as api:
            teach(api, "pendulum", pendulum(), queries=12)
        yield server


@pytest.fixture
def client(server: ServerProcess) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=server.url, timeout=60) as client:
        yield client


def opened(client: httpx.Client, **request: object) -> httpx.Response:
    return client.post("/v1/surrogates/pendulum/sessions", json={"seed": 0, "num_envs": 1, **request})


@pytest.fixture
def session(client: httpx.Client) -> Iterator[str]:
    id: str = opened(client).raise_for_status().json()["id"]
    client.post(f"/v1/sessions/{id}/reset", json={}).raise_for_status()
    yield id
    client.delete(f"/v1/sessions/{id}")


def refused(reply: httpx.Response, code: Code, *said: str) -> None:
    problem = Problem.model_validate_json(reply.content)
    assert problem.code == code, reply.text
    for words in said:
        assert words in problem.detail


def step_seconds(client: httpx.Client, session: str, steps: int = 60) -> float:
    """Median time of a step."""
    taken = []
    for _ in range(steps):
        started = time.perf_counter()
        client.post(f"/v1/sessions/{session}/step", json=ACTION).raise_for_status()
        taken.append(time.perf_counter() - started)
    return statistics.median(taken)


def test_the_total_memory_of_all_sessions_is_limited(client: httpx.Client):
    particles = {"variant": "probabilistic", "particles": 1_000_000}  # of two coordinates: 15.3 MiB
    refused(opened(client, **particles, num_envs=5), Code.TOO_LARGE, "4000000 particles")
    ids = [opened(client, **particles).raise_for_status().json()["id"] for _ in range(4)]
    full = opened(client, **particles)
    refused(full, Code.TOO_MANY_REQUESTS, "at most 64.0 MiB of memory, got 61.0 MiB and 15.3 MiB more")
    assert int(full.headers["retry-after"]) > 0
    for id in ids:
        client.delete(f"/v1/sessions/{id}")
    client.delete(f"/v1/sessions/{opened(client, **particles).raise_for_status().json()['id']}")


def test_a_step_that_cannot_meet_its_deadline_is_not_computed(client: httpx.Client, session: str):
    step_seconds(client, session, steps=5)  # now the server knows what one takes
    path, seq = f"/v1/sessions/{session}", client.get(f"/v1/sessions/{session}").json()["seq"]
    body = {"seq": seq + 1, "actions": [[[0.5]]] * 2_000}
    late = client.post(f"{path}/rollout", json=body, headers={"x-deadline-ms": "50"})
    refused(late, Code.DEADLINE_EXCEEDED, "the request would take")
    assert (late.status_code, int(late.headers["retry-after"]) > 0) == (503, True)
    assert client.get(path).json()["seq"] == seq
    client.post(f"{path}/rollout", json=body, headers={"x-deadline-ms": "60000"}).raise_for_status()
    refused(client.post(f"{path}/step", json=ACTION, headers={"x-deadline-ms": "soon"}), Code.INVALID_REQUEST, "'soon'")


NOT_FINITE = ["NaN", "Infinity", "-Infinity", "1e999"]


@pytest.mark.parametrize("number", [*NOT_FINITE, "[]", '"1"', "1e300"])
def test_invalid_action_numbers_are_refused(client: httpx.Client, session: str, number: str):
    reply = client.post(f"/v1/sessions/{session}/step", content=f'{{"action": [[{number}]]}}')
    assert reply.status_code in (415, 422)
    content = {"content-type": "application/json"}
    reply = client.post(f"/v1/sessions/{session}/step", content=f'{{"action": [[{number}]]}}', headers=content)
    refused(reply, Code.INVALID_REQUEST, "action")


@pytest.mark.parametrize("action", [5e-324, -5e-324, 0.0, -0.0])
def test_denormal_action_numbers_are_accepted(client: httpx.Client, session: str, action: float):
    reply = client.post(f"/v1/sessions/{session}/step", json={"action": [[action]]}).raise_for_status().json()
    assert np.isfinite(reply["observation"]).all()


def test_action_arrays_of_wrong_size_are_refused(client: httpx.Client, session: str):
    for action in ([], [[0.5]] * 5_000, [[0.5] * 5_000]):
        reply = client.post(f"/v1/sessions/{session}/step", json={"action": action})
        refused(reply, Code.INVALID_REQUEST, "action", "got")
    reply = client.post(f"/v1/sessions/{session}/step", json={"action": [[0.5]] * 1_000_000})
    refused(reply, Code.TOO_LARGE, "at most 65536 bytes", "send a larger body as application/vnd.msgpack")


def test_a_body_announced_as_a_gigabyte_is_refused_unread(server: ServerProcess):
    with connected(server.url) as attacker:
        started = time.monotonic()
        attacker.sendall(head(PATH, f"content-length: {GIGABYTE}", "", ""))
        reply = b""
        while not reply.endswith(b"}"):
            reply += attacker.recv(65_536)
    assert reply.startswith(b"HTTP/1.1 413")
    assert f"{JSON_BYTES} bytes as application/json, got {GIGABYTE}".encode() in reply
    assert time.monotonic() - started < REQUEST_SECONDS


def test_a_chunked_body_of_a_gigabyte_is_refused_at_the_limit(server: ServerProcess):
    """What is still read of it is thrown away, until the time for a request is over."""
    before, sent, chunk = resident_mib(server.process.pid), 0, b"x" * 2**20
    with connected(server.url) as attacker, contextlib.suppress(ConnectionError):
        attacker.sendall(head(PATH, "transfer-encoding: chunked", "", ""))
        while sent < GIGABYTE:
            attacker.sendall(b"%x\r\n%s\r\n" % (len(chunk), chunk))
            sent += len(chunk)
            attacker.setblocking(False)
            with contextlib.suppress(BlockingIOError):
                assert attacker.recv(12) == b"HTTP/1.1 413"
                break
            attacker.settimeout(60)
    assert JSON_BYTES <= sent < 2 * BODY_MIB * 2**20
    assert resident_mib(server.process.pid) < before + BODY_MIB


@pytest.fixture
def narrow(tmp_path: Path) -> Iterator[ServerProcess]:
    """A server of three connections, and 128 KiB for all bodies at once."""
    limits = {"SURROGYM_MAX_CONNECTIONS": "3", "SURROGYM_MAX_BODIES_BYTES": str(ALL_BYTES)}
    with running_server(tmp_path, **limits) as server:
        yield server


def test_connections_and_bodies_beyond_the_limit_are_refused(narrow: ServerProcess):
    body, unlike = b"x" * 90_000, f"expected bodies of at most {ALL_BYTES} bytes in all requests at once"
    with contextlib.ExitStack() as stack:
        first, second, _ = (stack.enter_context(connected(narrow.url)) for _ in range(3))
        time.sleep(0.5)
        with connected(narrow.url) as fourth:
            full = read_all(fourth)
        assert full.startswith(b"HTTP/1.1 503")
        assert b"retry-after" in full
        assert b"expected at most 3 connections" in full
        first.sendall(head(PATH, f"content-length: {len(body) + 1}", "", "") + body)
        time.sleep(0.5)
        second.sendall(head(PATH, f"content-length: {len(body)}", "connection: close", "", "") + body)
        reply = read_all(second)
        assert reply.startswith(b"HTTP/1.1 429")
        assert unlike.encode() in reply
    time.sleep(0.5)
    content = {"content-type": "application/json"}
    assert httpx.post(narrow.url + PATH, content=body, headers=content).status_code == 422, "there is room again"


def test_a_request_other_than_http_is_refused_with_a_reason(server: ServerProcess):
    with connected(server.url) as attacker:
        attacker.sendall(b"\x16\x03\x01 hello\r\n\r\n")
        reply = read_all(attacker)
    assert reply.startswith(b"HTTP/1.1 400")
    assert b"expected a request of HTTP/1.1" in reply


SLOW = [head(PATH)[:30], head(PATH, "content-length: 100", "", "") + b'{"sampler"']


@pytest.mark.parametrize("begun", SLOW, ids=["head", "body"])
def test_slow_senders_are_refused_and_others_are_served(
    server: ServerProcess, client: httpx.Client, session: str, begun: bytes
):
    """Fifty requests that come a byte a second."""
    calm = step_seconds(client, session)
    stop = threading.Event()

    def trickle() -> None:
        while not stop.wait(1.0):
            for attacker in attackers:
                with contextlib.suppress(OSError):
                    attacker.sendall(b"a")

    with contextlib.ExitStack() as stack:
        attackers = [stack.enter_context(connected(server.url)) for _ in range(50)]
        for attacker in attackers:
            attacker.sendall(begun)
        trickling, started = threading.Thread(target=trickle), time.monotonic()
        trickling.start()
        stack.callback(trickling.join)
        stack.callback(stop.set)
        assert step_seconds(client, session) < SLOWER * calm
        for attacker in attackers:
            told(attacker, f"a whole request within {REQUEST_SECONDS} s")
        assert time.monotonic() - started < 10 * REQUEST_SECONDS


def told(attacker: socket.socket, words: str) -> None:
    reply = read_all(attacker)
    assert reply.startswith(b"HTTP/1.1 408") or not reply, reply  # nothing, where its next byte came too late
    assert words.encode() in reply or not reply


def test_idle_connections_are_closed_and_others_are_served(server: ServerProcess, client: httpx.Client, session: str):
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and hard < IDLE + 512:
        pytest.skip(f"{IDLE} connections need {IDLE + 512} open files; this machine allows {hard}")
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    address = f"{server.url.replace('http', 'ws', 1)}/v1/sessions/{session}/stream"
    try:
        calm, before = step_seconds(client, session), resident_mib(server.process.pid)
        with contextlib.ExitStack() as stack:
            stream = stack.enter_context(connect(address, compression=None, open_timeout=60))
            idle = [stack.enter_context(connected(server.url)) for _ in range(IDLE)]
            assert step_seconds(client, session) < SLOWER * calm
            for attacker in idle:
                assert read_all(attacker).startswith(b"HTTP/1.1 408"), "closed, and told why"
            stream.send(frames.encode(frames.step_request(None, np.array([[0.5]]), None, False)))
            reply = frames.read_reply(bytes(stream.recv(timeout=60)))
            assert isinstance(reply, frames.StepReply), "a stream may be idle for longer"
            grown = resident_mib(server.process.pid) - before
        assert grown < 16 + IDLE * 0.04, "some ten thousand bytes each"
        assert step_seconds(client, session) < SLOWER * calm
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.parametrize("frame", [b"\x00\x80\0\0\0\0", b"\x89\x80\0\0\0\0", b"\x82\x80\0\0\0\0"])
def test_many_empty_websocket_frames_close_their_stream(server: ServerProcess, session: str, frame: bytes):
    with upgraded(server.url, session) as attacker, contextlib.suppress(ConnectionError):
        attacker.sendall(b"\x02\x80\0\0\0\0" + frame * 40_000)
        assert b"at most 256 frames in one message and in one read" in read_all(attacker)


def test_the_total_size_of_unfinished_stream_messages_is_limited(narrow: ServerProcess):
    """128 KiB in all streams there."""
    with Api(narrow.url) as api, httpx.Client(base_url=narrow.url, timeout=60) as client:
        teach(api, "pendulum", pendulum(), queries=6)
        id = opened(client).json()["id"]
    with upgraded(narrow.url, id) as attacker, contextlib.suppress(ConnectionError):
        attacker.sendall(b"\x82\xff" + (2**20).to_bytes(8, "big") + b"\0\0\0\0" + b"x" * (2 * ALL_BYTES))
        assert b"unfinished messages of at most 131072 bytes" in read_all(attacker)


def test_an_unfinished_stream_message_times_out_like_a_request(server: ServerProcess, session: str):
    with upgraded(server.url, session) as attacker:
        attacker.sendall(b"\x82\x8a\0\0\0\0abc")
        assert f"a whole message within {REQUEST_SECONDS} s".encode() in read_all(attacker)


def test_the_number_of_pipelined_requests_on_a_connection_is_limited(server: ServerProcess):
    with connected(server.url) as attacker, contextlib.suppress(ConnectionError):
        attacker.sendall(b"GET /v1/surrogates HTTP/1.1\r\nhost: 127.0.0.1\r\n\r\n" * 4_000)
        assert b"at most 16 unanswered requests on one connection" in read_all(attacker)


def test_a_stream_upgrade_with_another_method_than_get_is_refused(server: ServerProcess):
    lines = ("connection: Upgrade", "upgrade: websocket", "sec-websocket-version: 13", f"sec-websocket-key: {KEY}")
    with connected(server.url) as attacker:
        attacker.sendall(head("/v1/sessions/x/stream", *lines, "content-length: 3", "", "") + b"abc")
        assert b"expected GET to open a stream" in read_all(attacker)


def test_too_many_concurrent_readers_are_refused_while_others_are_served(server: ServerProcess, client: httpx.Client):
    body = {"coordinates": [0.1, 0.0], "actions": [[0.5]] * 40, "draws": 2}
    with ThreadPoolExecutor(50) as pool, httpx.Client(base_url=server.url, timeout=120) as lookers:
        asked = [pool.submit(lookers.post, "/v1/surrogates/pendulum/imagine", json=body) for _ in range(50)]
        claim = {"sampler": "worker", "wait_seconds": 0}
        assert client.post("/v1/surrogates/pendulum/queries:claim", json=claim, timeout=20).status_code == 200
        replies = [one.result() for one in asked]
    assert {reply.status_code for reply in replies} == {200, 429}
    beyond = next(reply for reply in replies if reply.status_code == 429)
    refused(beyond, Code.TOO_MANY_REQUESTS, "at most 34 predictions at work or waiting")


def test_the_body_of_a_get_request_is_ignored(server: ServerProcess, client: httpx.Client):
    for path in ("/v1/surrogates", "/healthz"):
        assert client.request("GET", path, content=b"x" * 100).status_code == 200
    with client.stream("GET", "/v1/events", content=b"x" * 10) as events:
        assert next(events.iter_lines()).startswith(": connected")
    assert "Traceback" not in server.log, server.log[-6000:]


def test_a_sampler_that_disconnected_while_waiting_gets_no_lease(server: ServerProcess, client: httpx.Client):
    client.post(
        "/v1/surrogates", json={"name": "idle", "spec": wire_pendulum.spec(initial=2, budget=2)}
    ).raise_for_status()
    wire_pendulum.claim(client, "idle", max_queries=2)
    waiting = b'{"sampler": "ghost", "wait_seconds": 30}'
    with connected(server.url) as ghost:
        ghost.sendall(head("/v1/surrogates/idle/queries:claim", f"content-length: {len(waiting)}", "", "") + waiting)
        time.sleep(0.5)
    time.sleep(0.5)
    by_hand = {"coordinates": [[0.9, 0.0]], "action": [[-1.0]]}
    client.post("/v1/surrogates/idle/queries", json=by_hand).raise_for_status()
    time.sleep(1.0)
    claimed = client.post("/v1/surrogates/idle/queries:claim", json={"sampler": "living"}).json()
    assert len(claimed["queries"]) == 1
    client.delete("/v1/surrogates/idle").raise_for_status()
