"""A real HTTP server on a loopback socket that does what a test's script says, also the impolite things."""

from __future__ import annotations

import base64
import hashlib
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from surrogym_shared import wire
from surrogym_shared.codes import STATUS, Code, Problem

WEBSOCKET_KEY = b"258EAFA5-E914-47DA-95CA-C5AB0DC85B11"  # RFC 6455, 1.3


@dataclass
class Received:
    method: str
    path: str
    body: bytes
    headers: dict[str, str]


Answer = Callable[[BaseHTTPRequestHandler], None]


@dataclass
class ScriptedServer:
    """Answers request i with ``script[i]``, and every later one with the last entry."""

    url: str
    script: list[Answer]
    received: list[Received] = field(default_factory=list)


def reply(body: str, status: int = 200, content_type: str = "application/json", delay: float = 0.0) -> Answer:
    def answer(handler: BaseHTTPRequestHandler) -> None:
        if delay:
            threading.Event().wait(delay)
        content = body.encode()
        handler.send_response(status)
        handler.send_header("Content-Type", content_type)
        handler.send_header("Content-Length", str(len(content)))
        handler.end_headers()
        handler.wfile.write(content)

    return answer


def problem(code: Code, detail: str = "why", expected_seq: int | None = None) -> Answer:
    body = Problem(title=code.value, status=STATUS[code], code=code, detail=detail, expected_seq=expected_seq)
    return reply(body.model_dump_json(), STATUS[code], "application/problem+json")


def upgrade(handler: BaseHTTPRequestHandler) -> None:
    """Accept the stream; what follows is for the script to say."""
    key = handler.headers["Sec-WebSocket-Key"].encode()
    handler.send_response(101)
    handler.send_header("Upgrade", "websocket")
    handler.send_header("Connection", "Upgrade")
    handler.send_header("Sec-WebSocket-Accept", base64.b64encode(hashlib.sha1(key + WEBSOCKET_KEY).digest()).decode())
    handler.end_headers()


def session_view(seq: int = 0, protocol: int = wire.PROTOCOL, delay: float = 0.0, replay: int = 0) -> Answer:
    """What opening or reading session ``abc`` of surrogate ``pendulum`` gives: two lanes, two observation entries."""
    session = wire.SessionView(
        protocol=protocol,
        id="abc",
        surrogate="pendulum",
        num_envs=2,
        variant="deterministic",
        seed=1,
        autoreset_mode="same_step",
        model="latest",
        model_version=[1, 1],
        seq=seq,
        time_limit=200,
        penalty=0.0,
        observation_space=wire.BoxSpace(low=[None, None], high=[None, None]),
        action_space=wire.BoxSpace(low=[-2.0], high=[2.0]),
        outputs=["angle", "reward"],
        idle_seconds=60.0,
        replay=replay,
    )
    return reply(session.model_dump_json(), delay=delay)


def lost_reply(handler: BaseHTTPRequestHandler) -> None:
    """Take the request and cut the connection."""
    handler.close_connection = True


@contextmanager
def scripted_server(*script: Answer) -> Iterator[ScriptedServer]:
    lock = threading.Lock()

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def _handle(self) -> None:
            body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
            with lock:
                number = len(server.received)
                server.received.append(Received(self.command, self.path, body, dict(self.headers)))
            try:
                server.script[min(number, len(server.script) - 1)](self)
            except OSError:
                self.close_connection = True

        do_GET = do_POST = do_PATCH = do_DELETE = _handle

        def log_message(self, format: str, *args: object) -> None:
            pass

    http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server = ScriptedServer(f"http://127.0.0.1:{http.server_port}", list(script))
    thread = threading.Thread(target=http.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    try:
        yield server
    finally:
        http.shutdown()
        http.server_close()
        thread.join()
