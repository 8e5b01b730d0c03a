"""Stream of binary messages to the server: a WebSocket without threads, on which each message gets one reply.

The websockets package implements the protocol; this module adds a blocking socket. A background thread would add two
thread switches to every step. After the handshake, complete binary messages are written and read here directly, and the
package handles every other frame.
"""

from __future__ import annotations

import secrets
import socket
from contextlib import suppress
from threading import Lock
from urllib.parse import urlsplit

import httpx
from pydantic import ValidationError
from websockets.client import ClientProtocol
from websockets.exceptions import InvalidHandshake, InvalidStatus, WebSocketException
from websockets.frames import CloseCode, Frame, Opcode
from websockets.http11 import Response
from websockets.protocol import State
from websockets.uri import parse_uri

from surrogym_client.errors import error_from_problem, refused_here
from surrogym_shared.codes import Code, Problem
from surrogym_shared.messages import KEY_BYTES, MASKED, WHOLE_BINARY, FrameSplitter, apply_mask, header

CHUNK_BYTES = 262_144
NO_SUCH_ROUTE = (Code.NOT_FOUND, Code.METHOD_NOT_ALLOWED)
DEFAULT_PORTS = {"http": 80, "https": 443}


class StreamUnavailable(OSError):
    """No stream could be opened, because nothing listens or the server offers no stream. No message was sent."""


class StreamLost(OSError):
    """The connection ended before the reply. The server may have carried out the request."""


class Stream:
    """One WebSocket connection, opened by its first message. Any failure closes it, so a late reply is never read.

    Only one thread at a time exchanges a message. A pickled copy opens its own connection.

    Args:
        url: address of the stream, beginning with http or https.
        token: bearer token, sent with the handshake.
        connect_seconds: time limit of connecting and of the handshake.
    """

    def __init__(self, url: str, token: str | None, connect_seconds: float) -> None:
        self._url = url
        self._token = token
        self._connect_seconds = connect_seconds
        self._socket: socket.socket | None = None
        self._protocol: ClientProtocol
        self._frames: FrameSplitter
        self._turn = Lock()

    def __reduce__(self) -> tuple[type[Stream], tuple[str, str | None, float]]:
        return Stream, (self._url, self._token, self._connect_seconds)

    def exchange(self, message: bytes, seconds: float) -> bytes:
        """Send a message and wait for its reply.

        Raises:
            StreamUnavailable: no connection exists, and none could be opened.
            StreamLost: the connection ended; the next message opens a new one.
            TimeoutError: no reply within ``seconds``.
            ProblemError: the server refused the connection, or the message is too large.
        """
        with self._turn:
            try:
                connected = self._socket or self._connect()
                if seconds != connected.gettimeout():  # an equal time-out needs no system call
                    connected.settimeout(seconds)
                key = secrets.token_bytes(KEY_BYTES)
                with suppress(ConnectionError):  # a server that refuses a large message stops reading, and answers
                    connected.sendall(b"".join((header(len(message), MASKED), key, apply_mask(message, key))))
                return self._receive(connected)
            except (WebSocketException, ConnectionError) as error:
                self.close()
                raise StreamLost(f"the connection broke before the reply: {error}") from error
            except BaseException:
                self.close()
                raise

    def close(self) -> None:
        """Close the connection. A later message opens a new one."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _connect(self) -> socket.socket:
        try:
            self._socket = _open_socket(self._url, self._connect_seconds)
            self._shake_hands(self._socket)
        except InvalidStatus as refusal:
            raise _refused(refusal.response) from refusal
        except (OSError, EOFError, InvalidHandshake) as error:
            raise StreamUnavailable(str(error) or "the server did not answer the WebSocket handshake") from error
        return self._socket

    def _shake_hands(self, connected: socket.socket) -> None:
        self._protocol = ClientProtocol(parse_uri(self._url.replace("http", "ws", 1)), max_size=None)
        request = self._protocol.connect()
        if self._token:
            request.headers["Authorization"] = f"Bearer {self._token}"
        self._protocol.send_request(request)
        self._flush(connected)
        while self._protocol.state is State.CONNECTING and self._protocol.handshake_exc is None:
            self._feed(connected)
        if self._protocol.handshake_exc is not None:
            raise self._protocol.handshake_exc
        self._protocol.events_received()  # discards the response to the handshake
        self._frames = FrameSplitter()

    def _receive(self, connected: socket.socket) -> bytes:
        parts: list[bytes] = []
        while True:
            whole = self._frames.split(self._read(connected))
            if len(whole) == 1 and not parts and whole[0][0][0] == WHOLE_BINARY:
                frame, extent = whole[0]
                assert extent is not None
                return frame[extent.payload :]
            for frame, _ in whole:
                self._protocol.receive_data(frame)
            message = self._gathered(parts)
            self._flush(connected)  # sends answers to pings
            if message is not None:
                return message

    def _gathered(self, parts: list[bytes]) -> bytes | None:
        """Return the message that ``parts`` so far and the protocol's new events make up; None if incomplete."""
        for event in self._protocol.events_received():
            assert isinstance(event, Frame)
            if event.opcode is Opcode.CLOSE:
                raise self._closed()
            if event.opcode in (Opcode.BINARY, Opcode.CONT):
                parts.append(bytes(event.data))
                if event.fin:
                    return b"".join(parts)
        return None

    def _read(self, connected: socket.socket) -> bytes:
        if chunk := connected.recv(CHUNK_BYTES):
            return chunk
        self._protocol.receive_eof()
        self._flush(connected)
        raise self._closed()

    def _feed(self, connected: socket.socket) -> None:
        """Read from the socket, and pass the server's answer to the handshake to the WebSocket protocol object."""
        if chunk := connected.recv(CHUNK_BYTES):
            self._protocol.receive_data(chunk)
        else:
            self._protocol.receive_eof()
        self._flush(connected)
        if not chunk and self._protocol.handshake_exc is None:
            raise self._closed()

    def _flush(self, connected: socket.socket) -> None:
        for chunk in self._protocol.data_to_send():
            if chunk:
                connected.sendall(chunk)

    def _closed(self) -> Exception:
        close = self._protocol.close_rcvd
        if close is None:
            return StreamLost("the stream ended without a closing message")
        if close.code == CloseCode.MESSAGE_TOO_BIG:
            return refused_here(Code.TOO_LARGE, f"expected a smaller message: {close.reason}")
        return StreamLost(f"the stream was closed with code {close.code}")


def _refused(response: Response) -> Exception:
    """Return the error for a refused handshake: the ``ProblemError`` from the server, or else ``StreamUnavailable``."""
    try:
        problem = Problem.model_validate_json(response.body or b"")
    except ValidationError:
        return StreamUnavailable(f"the upgrade was refused with status {response.status_code}")
    if problem.code in NO_SUCH_ROUTE:
        return StreamUnavailable("the server has no stream, or a proxy on the way removes the header that asks for one")
    return error_from_problem(problem)


def _open_socket(url: str, seconds: float) -> socket.socket:
    parts = urlsplit(url)
    assert parts.hostname is not None
    opened = socket.create_connection((parts.hostname, parts.port or DEFAULT_PORTS[parts.scheme]), seconds)
    opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    if parts.scheme == "https":
        return httpx.create_ssl_context().wrap_socket(opened, server_hostname=parts.hostname)
    return opened
