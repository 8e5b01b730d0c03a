"""The door of every route: content types, sizes and rights are settled before a body is read."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import httpx
import pytest
from fastapi.routing import APIRoute

from support.hostile import KEY, connected, read_all, resident_mib
from support.server import ServerProcess, running_server
from surrogym_server.api import events, metrics, models, queries, samples, service, sessions, surrogates
from surrogym_server.api.door import DEFAULT_JSON_BYTES, Door, door_of
from surrogym_server.api.stepping import routes
from surrogym_shared.codes import Code, Problem

JSON = "application/json"
ROOMS = (sessions, service, metrics, surrogates, queries, samples, models, events, routes)
ROUTES = {
    f"{min(route.methods)} {route.path}": door_of(route)
    for room in ROOMS
    for route in room.router.routes
    if isinstance(route, APIRoute)
}
WITH_BODY = {name: door for name, door in ROUTES.items() if door.bodies}
TOKEN = "the-token-of-the-owner"


def problem(reply: httpx.Response) -> Problem:
    return Problem.model_validate_json(reply.content)


def url_of(name: str) -> tuple[str, str]:
    method, path = name.split()
    return method, path.format(name="none", id="none", query_id=1, version=1)


# Largest JSON bodies in KiB of routes that take more than 128: the samples of a whole episode, and policies.
LARGER = {"add_sample": 1_024, "improve": 512, "queries": 512, "audit": 512}


def test_every_route_with_a_body_declares_its_content_type_and_size_limit():
    for name, door in ROUTES.items():
        method = name.split()[0]
        assert bool(door.bodies) == (method in ("POST", "PATCH", "PUT")), name
        most = 1_024 * LARGER.get(name.split("/")[-1], 128)
        assert door.bodies.get(JSON, 0) <= most, name


@pytest.mark.parametrize("name", WITH_BODY)
@pytest.mark.parametrize(
    "content_type", ["text/plain", "multipart/form-data", "application/x-www-form-urlencoded", None]
)
def test_a_body_with_an_unsupported_content_type_is_refused_on_every_route(
    client: httpx.Client, name: str, content_type: str | None
):
    """A page of another site can send these without asking: no browser would ask first."""
    method, url = url_of(name)
    reply = client.request(method, url, content=b"{}", headers={"content-type": content_type} if content_type else {})
    assert problem(reply).code == Code.UNSUPPORTED_MEDIA_TYPE
    assert f"got {content_type or 'none'}" in problem(reply).detail


@pytest.mark.parametrize("name", WITH_BODY)
def test_a_compressed_request_body_is_refused_with_its_encoding_named(client: httpx.Client, name: str):
    method, url = url_of(name)
    content_type = next(iter(WITH_BODY[name].bodies))
    reply = client.request(
        method, url, content=b"x", headers={"content-type": content_type, "content-encoding": "gzip"}
    )
    assert (problem(reply).code, "'gzip'" in problem(reply).detail) == (Code.UNSUPPORTED_MEDIA_TYPE, True)


@pytest.mark.parametrize("name", WITH_BODY)
def test_a_body_over_the_size_limit_of_its_route_is_refused(client: httpx.Client, name: str):
    method, url = url_of(name)
    for content_type, limit in WITH_BODY[name].bodies.items():
        if limit is not None:
            reply = client.request(method, url, content=b" " * (limit + 1), headers={"content-type": content_type})
            assert problem(reply).code == Code.TOO_LARGE
            assert f"at most {limit} bytes as {content_type}, got {limit + 1} bytes" in problem(reply).detail


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b'{"sampler": "a", "sampler": "b"}', 'duplicate key "sampler"'),
        (b"[" * 1_000, "at most 200 levels"),
        (b"\x1f\x8b\x08", "expected JSON in UTF-8"),
        (b"{" + b",".join(b'"%d": 0' % i for i in range(65)) + b"}", "at most 64 fields, got 65"),
    ],
    ids=["duplicate key", "nested", "zipped", "fields"],
)
def test_json_with_repeated_keys_deep_nesting_or_too_many_fields_is_refused_with_the_reason(
    client: httpx.Client, content: bytes, said: str
):
    for path in ("/v1/surrogates/none/queries:claim", "/v1/sessions/none/step"):
        reply = client.post(path, content=content, headers={"content-type": JSON})
        assert (reply.status_code, problem(reply).code) == (422, Code.INVALID_REQUEST)
        assert said in problem(reply).detail


def test_a_route_without_declared_roles_is_rejected():
    async def forgotten() -> None: ...

    with pytest.raises(TypeError, match="expected one declaration of who may call it"):
        door_of(APIRoute("/forgotten", forgotten))


def test_roles_and_body_limits_are_read_from_the_declaration_of_a_route():
    assert ROUTES["GET /healthz"] == Door(None, {})
    assert ROUTES["POST /v1/surrogates"] == Door((), {JSON: 2 * DEFAULT_JSON_BYTES})
    assert all(door.roles is not None for name, door in ROUTES.items() if name.split()[1].startswith("/v1"))


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServerProcess]:
    with running_server(tmp_path_factory.mktemp("guarded"), SURROGYM_TOKEN=TOKEN) as server:
        yield server


def begun(server: ServerProcess, name: str, *lines: str) -> socket.socket:
    """The head of a request whose body never comes."""
    method, url = url_of(name)
    opened = connected(server.url, seconds=20.0)
    opened.sendall("\r\n".join([f"{method} {url} HTTP/1.1", "host: 127.0.0.1", *lines, "", ""]).encode())
    return opened


@pytest.mark.parametrize("name", WITH_BODY)
def test_a_request_without_token_is_refused_before_its_body_is_read(guarded: ServerProcess, name: str):
    with begun(guarded, name, "content-length: 1000", f"content-type: {JSON}") as stranger:
        assert stranger.recv(65_536).startswith(b"HTTP/1.1 401")


@pytest.mark.parametrize("name", WITH_BODY)
def test_an_unsupported_content_type_is_refused_before_the_body_is_read(guarded: ServerProcess, name: str):
    with begun(guarded, name, "content-length: 1000", f"authorization: Bearer {TOKEN}", "content-type: a/b") as owner:
        assert owner.recv(65_536).startswith(b"HTTP/1.1 415")


HEADER = b"x-%d: " + b"a" * 60 + b"\r\n"
BEGINNINGS = {
    "one header": (b"GET /healthz HTTP/1.1\r\nhost: 127.0.0.1\r\nx-long: ", b"a" * 1024),
    "many headers": (b"GET /healthz HTTP/1.1\r\nhost: 127.0.0.1\r\n", HEADER),
    "target": (b"GET /", b"a" * 1024),
    "trailers": (
        b"POST /v1/surrogates HTTP/1.1\r\nhost: 127.0.0.1\r\ntransfer-encoding: chunked\r\n\r\n0\r\n",
        HEADER,
    ),
    "chunk extension": (
        b"POST /v1/surrogates HTTP/1.1\r\nhost: 127.0.0.1\r\ntransfer-encoding: chunked\r\n\r\n5;",
        b"a" * 1024,
    ),
}


@pytest.mark.parametrize("kind", BEGINNINGS)
def test_an_endless_request_head_is_refused_with_bounded_memory(guarded: ServerProcess, kind: str):
    """A trickle of 4 MiB, slow enough for the refusal to be read; the server keeps 64 KiB of it at most."""
    beginning, more = BEGINNINGS[kind]
    before, sent, refused = resident_mib(guarded.process.pid), 0, b""
    with connected(guarded.url, seconds=20.0) as attacker:
        attacker.sendall(beginning)
        try:
            while sent < 4 * 2**20:
                attacker.sendall(more % sent if b"%" in more else more)
                sent += len(more)
        except ConnectionError:
            pass
        refused = read_all(attacker)
    assert sent < 4 * 2**20, "the connection was closed"
    assert refused == b"" or b" 431 " in refused.partition(b"\r\n")[0] or b" 401 " in refused.partition(b"\r\n")[0]
    assert resident_mib(guarded.process.pid) < before + 8


@pytest.mark.parametrize(
    ("lines", "status"),
    [
        (["x-a: " + "a" * 60_000], b"200"),
        (["x-a: " + "a" * 70_000], b"431"),
        (["a: b"] * 98, b"200"),
        (["a: b"] * 101, b"431"),
    ],
)
def test_a_request_head_is_refused_exactly_beyond_the_stated_limits(
    guarded: ServerProcess, lines: list[str], status: bytes
):
    with connected(guarded.url, seconds=20.0) as caller:
        head = ["GET /healthz HTTP/1.1", "host: 127.0.0.1", *lines, "", ""]
        caller.sendall("\r\n".join(head).encode())
        reply = caller.recv(65_536)
    assert reply.split()[1] == status
    if status == b"431":
        assert b"at most 100 headers and 65536 bytes" in reply


@pytest.mark.parametrize(
    ("id", "line"),
    [("a" * 20_000, ""), ("none", "x-a: " + "a" * 20_000), ("none", "content-length: 5"), ("none", "a: \x80")],
    ids=["long id", "long header", "body", "not ASCII"],
)
def test_a_malformed_websocket_handshake_gets_an_error_reply(guarded: ServerProcess, id: str, line: str):
    """The library that reads handshakes has limits of its own; such a connection would stay open without a reply."""
    upgrade = ["upgrade: websocket", "connection: upgrade", "sec-websocket-version: 13", f"sec-websocket-key: {KEY}"]
    lines = [f"GET /v1/sessions/{id}/stream HTTP/1.1", "host: 127.0.0.1", *upgrade, *([line] if line else []), "", ""]
    with connected(guarded.url, seconds=20.0) as caller:
        caller.sendall("\r\n".join(lines).encode("latin-1"))
        reply = read_all(caller)
    assert int(reply.split()[1]) in (400, 401), reply
    assert b"application/problem+json" in reply
