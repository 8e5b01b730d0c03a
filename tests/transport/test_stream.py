"""One stream against a server that does what a test says: late, cut, fragmented and refused replies. Real sockets."""

from __future__ import annotations

import pickle
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler

import pytest
from websockets.http11 import Request, Response
from websockets.sync.server import ServerConnection, serve

from support.scripted_server import lost_reply, problem, reply, scripted_server, upgrade
from surrogym_client import errors
from surrogym_client.transport.stream import Stream, StreamLost, StreamUnavailable
from surrogym_shared.codes import Code

Handler = Callable[[ServerConnection], None]


@contextmanager
def serving(handler: Handler, **options) -> Iterator[tuple[str, list[Request]]]:
    """A WebSocket server; gives its address and the handshakes it has seen."""
    seen: list[Request] = []

    def note(_: ServerConnection, request: Request) -> Response | None:
        seen.append(request)
        return None

    with serve(handler, "127.0.0.1", 0, process_request=note, **options) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.socket.getsockname()[1]}/x", seen
        finally:
            server.shutdown()
            thread.join()


@contextmanager
def stream(url: str, token: str | None = None) -> Iterator[Stream]:
    opened = Stream(url, token, connect_seconds=5.0)
    try:
        yield opened
    finally:
        opened.close()


def echo(connection: ServerConnection) -> None:
    for message in connection:
        connection.send(message)


@pytest.mark.parametrize("size", [0, 1, 125, 126, 65_535, 65_536, 3_000_000])
def test_stream_messages_of_any_size_are_received(size: int):
    message = bytes(range(256)) * (size // 256) + b"x" * (size % 256)
    with serving(echo, max_size=None) as (url, seen), stream(url) as opened:
        assert opened.exchange(message, 30) == message
        assert opened.exchange(b"again", 30) == b"again"
    assert len(seen) == 1, "one connection carries many messages"


def test_the_stream_handshake_contains_the_token_even_after_pickling():
    with serving(echo) as (url, seen), stream(url, "secret") as opened:
        opened.exchange(b"1", 30)
        copy = pickle.loads(pickle.dumps(opened))
        assert copy.exchange(b"2", 30) == b"2"
        copy.close()
    assert [request.headers["Authorization"] for request in seen] == ["Bearer secret"] * 2


def test_a_fragmented_stream_reply_with_pings_is_received_as_one():
    def in_parts(connection: ServerConnection) -> None:
        for _ in connection:
            connection.ping()
            connection.send(iter([b"one ", b"two ", b"three"]))

    with serving(in_parts) as (url, _), stream(url) as opened:
        assert opened.exchange(b"", 30) == b"one two three"
        assert opened.exchange(b"", 30) == b"one two three"


def test_a_late_stream_reply_is_dropped():
    late = threading.Event()

    def dawdling(connection: ServerConnection) -> None:
        for message in connection:
            if message == b"slow":
                late.wait(30)
            connection.send(message)

    with serving(dawdling) as (url, seen), stream(url) as opened:
        with pytest.raises(TimeoutError):
            opened.exchange(b"slow", 0.1)
        late.set()
        assert opened.exchange(b"next", 30) == b"next"
        assert len(seen) == 2


def test_a_broken_stream_raises_and_the_next_message_reconnects():
    def once(connection: ServerConnection) -> None:
        connection.send(connection.recv())

    with serving(once) as (url, seen), stream(url) as opened:
        for message in (b"1", b"2"):
            assert opened.exchange(message, 30) == message
            with pytest.raises(StreamLost, match=r"^the stream (was closed|broke|ended)"):
                opened.exchange(b"more", 30)
        assert len(seen) == 2


def test_a_too_large_stream_message_is_not_reported_as_lost_connection():
    with (
        serving(echo, max_size=1000) as (url, _),
        stream(url) as opened,
        pytest.raises(errors.TooLarge, match="expected a smaller message"),
    ):
        opened.exchange(b"x" * 2000, 30)


def test_a_stream_closed_within_a_message_raises_with_the_servers_reason():
    def refuse(handler: BaseHTTPRequestHandler) -> None:
        upgrade(handler)
        handler.rfile.read(2)
        reason = (1009).to_bytes(2, "big") + b"it is too big"
        handler.wfile.write(bytes((0x88, len(reason))) + reason)
        handler.close_connection = True

    with (
        scripted_server(refuse) as server,
        stream(server.url) as opened,
        pytest.raises(errors.TooLarge, match="expected a smaller message: it is too big"),
    ):
        opened.exchange(b"x" * 40_000_000, 30)


@pytest.mark.parametrize(
    "answer",
    [
        reply("<html>", 426, "text/html"),
        reply("<html>", 502, "text/html"),
        reply("{}", 200),
        problem(Code.NOT_FOUND),
        lost_reply,
    ],
)
def test_a_server_that_offers_no_stream_raises_stream_unavailable(answer):
    with scripted_server(answer) as server, stream(server.url) as opened, pytest.raises(StreamUnavailable):
        opened.exchange(b"", 30)


@pytest.mark.parametrize(
    ("code", "error"),
    [
        (Code.UNKNOWN_SESSION, errors.UnknownSession),
        (Code.FORBIDDEN, errors.Forbidden),
        (Code.UNAVAILABLE, errors.Unavailable),
    ],
)
def test_an_error_reply_on_a_stream_is_raised_as_its_own_exception(code: Code, error: type[Exception]):
    with scripted_server(problem(code)) as server, stream(server.url) as opened, pytest.raises(error):
        opened.exchange(b"", 30)


def test_opening_a_stream_to_an_unreachable_server_raises():
    with serving(echo) as (url, _):
        pass
    with stream(url) as opened, pytest.raises(StreamUnavailable):
        opened.exchange(b"", 30)
