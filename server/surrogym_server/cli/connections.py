"""uvicorn's HTTP protocol with limits on the number of connections, and on the size and duration of a request."""

from __future__ import annotations

import asyncio
import resource
from typing import Any

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol, RequestResponseCycle

from surrogym_server.api.problems import closing_reply
from surrogym_shared.codes import Code

MAX_HEADERS = 100
MAX_HEAD_BYTES = 64 * 1024
HEAD_TOO_LARGE = 431
HEAD = (
    f"expected at most {MAX_HEADERS} headers and {MAX_HEAD_BYTES} bytes of target, headers and trailers of a request, "
    "got more: send shorter ones"
)
MAX_PIPELINED = 16  # largest number of unanswered requests on one connection
SPARE_FILES = 128  # file descriptors kept free for the database, pipes and other open files besides connections


def connections_within(most: int) -> int:
    """Raise this process's limit of open files as far as the system allows. Return how many connections it permits, at
    most ``most``.
    """
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    return most if hard == resource.RLIM_INFINITY else max(min(most, hard - SPARE_FILES), 1)


class TooMuch(Exception):
    """A request exceeds a limit. Raised in a callback of the HTTP parser, to stop the parser."""

    def __init__(self, detail: str, status: int) -> None:
        super().__init__(detail)
        self.status = status


class Patient(HttpToolsProtocol):
    """uvicorn's HTTP protocol with limits on the number of connections, on the size of a request's headers, and on the
    time in which a request has to arrive.
    """

    seconds: float  # longest time in which a request has to arrive
    most: int  # largest number of connections
    _timer: asyncio.TimerHandle | None = None
    _head_bytes = 0  # bytes of the present request's target, headers and trailers so far
    _head_lines = 0
    _head_complete = False
    _too_much: TooMuch | None = None
    _working: RequestResponseCycle | None = None  # the request that the app is answering, or answered last
    _unparsed = 0  # bytes received since the parser last completed a header, a chunk or another part of a request

    def data_received(self, data: bytes) -> None:
        self._unparsed += len(data)
        super().data_received(data)
        if self._unparsed > MAX_HEAD_BYTES and not self.transport.is_closing():
            self._refuse(Code.TOO_LARGE, HEAD, status=HEAD_TOO_LARGE)

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        if len(self.connections) > self.most:
            self._refuse(Code.UNAVAILABLE, f"expected at most {self.most} connections, got one more: close some")
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
        # A trailer (header after the body) counts towards the limits of a request's size, but the app does not get it.
        if not self._head_complete:
            super().on_header(name, value)

    def on_headers_complete(self) -> None:
        self._head_complete, self._unparsed = True, 0
        if len(self.pipeline) >= MAX_PIPELINED:
            self._stop(
                f"expected at most {MAX_PIPELINED} unanswered requests on one connection, got one more: "
                "wait for answers",
                429,
            )
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
            self._refuse(
                Code.REQUEST_TIMEOUT,
                f"expected a whole request within {self.seconds:g} s, got a part or nothing: send it again",
            )

    def _start_asgi_task(self, cycle: RequestResponseCycle, app: Any) -> None:
        self._working = cycle
        super()._start_asgi_task(cycle, app)

    def _refuse(self, code: Code, detail: str, status: int | None = None) -> None:
        if self._working is not None:  # the app need not finish its answer, because the connection is closed
            self._working.disconnected = True
            self._working.message_event.set()
        self.transport.write(closing_reply(code, detail, status))
        self.transport.close()


def patient(seconds: float, most: int) -> type[HttpToolsProtocol]:
    """Return a subclass of ``Patient`` for uvicorn, which takes a class.

    Args:
        seconds: longest time in which a request has to arrive.
        most: largest number of connections.
    """
    return type("Patient", (Patient,), {"seconds": seconds, "most": most})
