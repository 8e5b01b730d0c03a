"""Run the server process, from opening its socket to a clean shutdown. uvicorn's HTTP protocol has limits on the
number of connections, and on the size and duration of a request."""

from __future__ import annotations

import asyncio
import gc
import logging
import os
import resource
import signal
import socket
import threading
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager, nullcontext
from pathlib import Path
from types import FrameType
from typing import Any

import uvicorn
from fastapi import FastAPI
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol, RequestResponseCycle

from surrogym_server import logs
from surrogym_server.api.problems import closing_reply
from surrogym_server.api.stepping.messages import prompt
from surrogym_server.app import create_app, say_goodbye
from surrogym_server.engine.fits import Fits
from surrogym_server.errors import InvalidInput
from surrogym_server.settings import Settings
from surrogym_shared.codes import Code

logger = logging.getLogger(__name__)

GRACE_SECONDS = 5
YOUNG_OBJECTS = 20_000  # number of new objects after which Python collects garbage among them
PARENT_LOOK_SECONDS = 0.5
Tell = Callable[[str], None]

ANY_ADDRESS = {"0.0.0.0": "127.0.0.1", "::": "::1"}


class Runner(uvicorn.Server):
    """uvicorn's server, extended: it announces its address, ends waiting requests at shutdown, and returns normally
    after a signal.
    """

    def __init__(self, app: FastAPI, settings: Settings, url: str, ready_file: Path | None, tell: Tell) -> None:
        config = uvicorn.Config(
            app,
            http=patient(settings.request_seconds, connections_within(settings.max_connections)),
            ws=prompt(settings.request_seconds, settings.max_bodies_bytes),
            log_config=None,
            access_log=False,  # replaced by the log of ``api.middleware``, which has the request's id and sender
            server_header=False,
            ssl_certfile=settings.tls_certificate,
            ssl_keyfile=settings.tls_key,
            timeout_graceful_shutdown=GRACE_SECONDS,
            ws_max_size=settings.max_body_bytes,
            ws_per_message_deflate=False,  # compression of numbers takes more time than it saves
            ws_ping_timeout=None,  # a trainer that is learning may answer no ping for minutes
        )
        super().__init__(config)
        self._app = app
        self._url = url
        self._ready_file = ready_file
        self._tell = tell
        self._ended_by: signal.Signals | None = None

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        _exempt_from_collection()
        if self._ready_file is not None:
            _write_at_once(self._ready_file, self._url)
        self._tell(self._url)

    @contextmanager
    def capture_signals(self) -> Generator[None, None, None]:
        """Return a context that handles uvicorn's signals and also SIGHUP, which a closing terminal sends. Under nohup,
        SIGHUP stays ignored."""
        ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
        with super().capture_signals(), nullcontext() if ignored else _handled(signal.SIGHUP, self.handle_exit):
            yield

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        if self._ended_by is not None:
            logger.info("%s: the server stops", self._ended_by.name)
        say_goodbye(self._app)
        await super().shutdown(sockets)

    def handle_exit(self, sig: int, _: FrameType | None) -> None:
        self.force_exit = self.should_exit and sig == signal.SIGINT
        self.should_exit = True
        self._ended_by = signal.Signals(sig)


def run(settings: Settings, ready_file: Path | None, exit_with_parent: bool, tell: Tell) -> None:
    """Serve until a signal arrives or the parent process ends.

    Args:
        settings: the server's settings.
        ready_file: file to write the URL to, once requests are accepted.
        exit_with_parent: whether to end when the parent process ends.
        tell: called with the URL, once requests are accepted.

    Raises:
        InvalidInput: the server can't listen on the address, or a setting can't be used.
        Unavailable: the database is in use by another server, or does not answer.
    """
    logs.configure(settings.log_level, settings.log_format)
    with _fits(settings) as fits, _listen(settings.host, settings.port) as listener:
        runner = Runner(create_app(settings, fits=fits), settings, _url(listener, settings), ready_file, tell)
        if exit_with_parent:
            threading.Thread(target=_end_with_parent, args=(runner, os.getppid()), daemon=True).start()
        runner.run(sockets=[listener])


@contextmanager
def _fits(settings: Settings) -> Iterator[Fits | None]:
    """Return a context whose value runs fits in child processes, or is None if another engine than ``local`` decides
    where fits run. The first child process is started now, because a fork is cheap and safe only before other modules
    and threads are loaded."""
    if settings.engine != "local":
        yield None
        return
    with closing(Fits(idle=settings.fit_workers, forks=True)) as fits:
        fits.start()
        yield fits


@contextmanager
def _handled(sig: signal.Signals, handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    before = signal.signal(sig, handler)
    try:
        yield
    finally:
        signal.signal(sig, before)


def _exempt_from_collection() -> None:
    """Exempt all objects that exist now from garbage collection, and enable the collector for later objects.

    The present objects belong to torch and other imports and stay alive. A full collection would traverse them, which
    delays steps by some 200 ms. Python collects garbage after 700 new objects by default. Here the collector waits for
    ``YOUNG_OBJECTS`` new objects, because a request for 1,000 samples creates far more than 700 objects, which all stay
    in use.
    """
    gc.freeze()
    gc.set_threshold(YOUNG_OBJECTS, *gc.get_threshold()[1:])
    gc.enable()


def _listen(host: str, port: int) -> socket.socket:
    """Return a socket bound to the address. It is opened first, so that a port in use is reported at once."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listener = socket.socket(family, kind, protocol)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
    except OSError as error:
        raise InvalidInput(
            f"can't listen on {host} port {port}: {error.strerror or error}; choose another by --host and --port"
        ) from error
    return listener


def _url(listener: socket.socket, settings: Settings) -> str:
    """Return the URL by which a client on this machine reaches the server."""
    name = ANY_ADDRESS.get(settings.host, settings.host)
    scheme = "http" if settings.tls_certificate is None else "https"
    return f"{scheme}://{f'[{name}]' if ':' in name else name}:{listener.getsockname()[1]}"


def _write_at_once(path: Path, text: str) -> None:
    """Write a file atomically, so that readers see either no file or the whole text."""
    draft = path.with_name(f"{path.name}.tmp")
    draft.write_text(text, encoding="utf-8")
    draft.replace(path)


def _end_with_parent(runner: Runner, parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(PARENT_LOOK_SECONDS)
    runner.should_exit = True


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
