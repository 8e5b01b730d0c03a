"""Connections that bring no request, or too slowly, or are too many; and messages answered where they arrive."""

from __future__ import annotations

import asyncio
import resource
from typing import Any

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol, RequestResponseCycle
from uvicorn.protocols.utils import ClientDisconnected
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.frames import CloseCode
from websockets.protocol import State

from surrogym_server.api.problems import problem_response
from surrogym_server.api.stream import EXTENSION, Prompt
from surrogym_shared.codes import Code
from surrogym_shared.messages import MASKED, WHOLE_BINARY, Extent, FrameSplitter, apply_mask, header

MAX_HEADERS = 100
MAX_HEAD_BYTES = 64 * 1024
HEAD_TOO_LARGE = 431
HEAD = (
    f"expected at most {MAX_HEADERS} headers and {MAX_HEAD_BYTES} bytes of target, headers and trailers of a request, "
    "got more"
)
MAX_FRAMES = 256  # of a WebSocket in one read, and fragments of one message
MAX_PIPELINED = 16  # requests of one connection that wait for the one before them
SPARE_FILES = 128  # for the database, pipes and whatever else is open beside connections


def connections_within(most: int) -> int:
    """Raise this process's limit of open files as far as it may; returns how many connections then fit, at most."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    return most if hard == resource.RLIM_INFINITY else max(min(most, hard - SPARE_FILES), 1)


class TooMuch(Exception):
    """Raised inside the parser, which then stops: what came is beyond a limit."""

    def __init__(self, detail: str, status: int) -> None:
        super().__init__(detail)
        self.status = status


class Patient(HttpToolsProtocol):
    """uvicorn's protocol, with limits of connections, of a request's head, and of the time it takes to arrive whole."""

    seconds: float
    most: int  # connections
    _timer: asyncio.TimerHandle | None = None
    _head_bytes = 0  # of target, headers and trailers of this request
    _head_lines = 0
    _head_complete = False
    _too_much: TooMuch | None = None
    _working: RequestResponseCycle | None = None  # the request that the app works at, or did last
    _unparsed = 0  # bytes since the parser last came to the end of something

    def data_received(self, data: bytes) -> None:
        self._unparsed += len(data)
        super().data_received(data)
        if self._unparsed > MAX_HEAD_BYTES and not self.transport.is_closing():
            self._refuse(Code.TOO_LARGE, HEAD, status=HEAD_TOO_LARGE)

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        if len(self.connections) > self.most:
            self._refuse(Code.UNAVAILABLE, f"expected at most {self.most} connections, got one more")
        else:
            self._wait()

    def connection_lost(self, exc: Exception | None) -> None:
        self._arrived()
        super().connection_lost(exc)

    def on_message_begin(self) -> None:
        super().on_message_begin()
        self._head_bytes = self._head_lines = self._unparsed = 0
        self._head_complete = False
        self._arrived()
        self._wait()

    def on_url(self, url: bytes) -> None:
        self._count(len(url))
        super().on_url(url)

    def on_header(self, name: bytes, value: bytes) -> None:
        self._head_lines += 1
        self._count(len(name) + len(value))
        if not self._head_complete:  # a trailer is counted, and nobody reads it
            super().on_header(name, value)

    def on_headers_complete(self) -> None:
        self._head_complete, self._unparsed = True, 0
        if len(self.pipeline) >= MAX_PIPELINED:
            self._stop(f"expected at most {MAX_PIPELINED} requests that wait for an answer, got one more", 429)
        super().on_headers_complete()

    def on_body(self, body: bytes) -> None:
        self._unparsed = 0
        super().on_body(body)

    def on_chunk_header(self) -> None:
        self._unparsed = 0

    def on_message_complete(self) -> None:
        self._unparsed = 0
        self._arrived()
        super().on_message_complete()

    def send_400_response(self, msg: str) -> None:
        if self._too_much is not None:
            self._refuse(Code.TOO_LARGE, str(self._too_much), status=self._too_much.status)
        else:
            self._refuse(Code.INVALID_REQUEST, f"expected a request of HTTP/1.1, got none: {msg}", status=400)

    def handle_websocket_upgrade(self) -> None:
        if self.scope["method"] == "GET":
            super().handle_websocket_upgrade()
        else:
            self._refuse(Code.INVALID_REQUEST, "expected GET to open a stream, got another method", status=400)

    def _count(self, size: int) -> None:
        self._head_bytes += size
        if self._head_bytes > MAX_HEAD_BYTES or self._head_lines > MAX_HEADERS:
            self._stop(HEAD, HEAD_TOO_LARGE)

    def _stop(self, detail: str, status: int) -> None:
        self._too_much = TooMuch(detail, status)
        raise self._too_much

    def _wait(self) -> None:
        self._timer = asyncio.get_running_loop().call_later(self.seconds, self._late)

    def _arrived(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _late(self) -> None:
        answering = self.cycle is not None and not self.cycle.response_complete
        if answering and (self.cycle.response_started or self.pipeline):
            self.transport.close()
        else:
            self._refuse(Code.REQUEST_TIMEOUT, f"expected a whole request within {self.seconds:g} s")

    def _start_asgi_task(self, cycle: RequestResponseCycle, app: Any) -> None:
        self._working = cycle
        super()._start_asgi_task(cycle, app)

    def _refuse(self, code: Code, detail: str, status: int | None = None) -> None:
        if self._working is not None:  # its answer would go to a closed connection
            self._working.disconnected = True
            self._working.message_event.set()
        reply = problem_response(code, detail, status=status, headers={"connection": "close"})
        lines = b"".join(name + b": " + value + b"\r\n" for name, value in reply.raw_headers)
        self.transport.write(b"HTTP/1.1 %d \r\n%s\r\n%s" % (reply.status_code, lines, bytes(reply.body)))
        self.transport.close()


def patient(seconds: float, most: int) -> type[HttpToolsProtocol]:
    """``Patient`` with its limits, as uvicorn takes it: a class."""
    return type("Patient", (Patient,), {"seconds": seconds, "most": most})


class Unfinished:
    """Bytes of messages that have begun and not ended, of all streams together."""

    def __init__(self, most: int) -> None:
        self.most = most
        self.bytes = 0


def prompt(seconds: float, most_together: int) -> type[WebSocketsSansIOProtocol]:
    """uvicorn's WebSocket, with a limit of seconds for a message to arrive whole, and of bytes of unfinished messages
    in all streams together."""
    unfinished = Unfinished(most_together)

    class Bounded(PromptMessages):
        _together, _seconds = unfinished, seconds

    return Bounded


class PromptMessages(WebSocketsSansIOProtocol):
    """uvicorn's WebSocket, which offers the app to answer a message where it arrives.

    The way of ASGI wakes a task through a queue, and back, for each message. That takes as long as all else a small
    step needs. What is no whole binary message, and what the app does not answer at once, goes that way all the same;
    so does everything while the app is busy, and so the order of messages is kept. The library gets whole frames alone.
    """

    _together = Unfinished(2**28)
    _seconds = 30.0
    _answer: Prompt | None = None
    _oversized = False  # a frame that the library is to refuse; what follows belongs to it
    _waiting = False  # the app has asked for the next message
    _counted = 0  # of ``_together``
    _timer: asyncio.TimerHandle | None = None

    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self._frames = FrameSplitter(self.config.ws_max_size, MAX_FRAMES)

    def handle_connect(self, event: Any) -> None:
        super().handle_connect(event)
        if hasattr(self, "scope"):
            offers: dict[str, Any] = self.scope["extensions"]
            offers[EXTENSION] = self._take

    def data_received(self, data: bytes) -> None:
        if not self.handshake_initiated or self._oversized:  # the handshake comes whole, from the HTTP protocol
            super().data_received(data)
            return
        whole = self._frames.split(data)
        if len(whole) > MAX_FRAMES or len(self.frames) > MAX_FRAMES:
            self._end(f"expected at most {MAX_FRAMES} frames at once and in one message, got more")
            return
        for frame, extent in whole:
            self._oversized = extent is None
            if len(whole) > 1 or extent is None or not self._answered(self._answer, frame, extent):
                super().data_received(frame)
        self._count(self._frames.held + sum(map(len, self.frames)))

    def connection_lost(self, exc: Exception | None) -> None:
        self._count(0)
        super().connection_lost(exc)

    def send_receive_event_to_app(self) -> None:
        if self.curr_msg_data_type == "text":  # refused by the app, and uvicorn logs an error for what is no UTF-8
            self.frames = [b"".join(self.frames).decode(errors="replace").encode()]
        super().send_receive_event_to_app()

    async def receive(self) -> Any:
        self._waiting = True
        try:
            return await super().receive()
        finally:
            self._waiting = False

    async def send(self, message: Any) -> None:
        if self.close_sent:  # for a frame that is none, while the app answered the message before it
            raise ClientDisconnected
        await super().send(message)
        self.handshake_complete |= self.close_sent  # by a refusal; uvicorn would call it none, and log an error

    def _take(self, answer: Prompt) -> None:
        self._answer = answer

    def _answered(self, answer: Prompt | None, frame: bytes, extent: Extent) -> bool:
        free = self._waiting and self.queue.empty() and not self.frames and self.writable.is_set()
        if answer is None or not free or frame[0] != WHOLE_BINARY or not frame[1] & MASKED:
            return False
        message = apply_mask(frame[extent.payload :], frame[extent.key : extent.payload])
        if self.close_sent or (reply := answer(message)) is None:
            return False
        self.transport.write(b"".join((header(len(reply)), reply)))
        return True

    def _count(self, unfinished: int) -> None:
        """Note how many bytes of an unfinished message are held, and end the connection where that is too much."""
        if unfinished == self._counted:
            return
        self._together.bytes += unfinished - self._counted
        self._counted = unfinished
        if self._timer is not None and not unfinished:
            self._timer.cancel()
            self._timer = None
        elif self._timer is None and unfinished:
            late = f"expected a whole message within {self._seconds:g} s"
            self._timer = self.loop.call_later(self._seconds, self._end, late)
        if self._together.bytes > self._together.most:
            self._end(f"expected unfinished messages of at most {self._together.most} bytes in all streams, got more")

    def _end(self, reason: str) -> None:
        """Close the connection because of what came."""
        if self.close_sent or self.transport.is_closing():
            return
        if self.conn.state is State.OPEN:
            self.conn.send_close(CloseCode.POLICY_VIOLATION, reason)
            self.handle_parser_exception()
        else:
            self.transport.close()
