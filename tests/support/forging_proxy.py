"""An HTTP proxy that forges: it changes requests on their way to a real server, or its replies; carries no stream."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import httpx

Forge = Callable[[str, dict[str, Any]], None]  # changes a JSON object on the way, given its path


def leave(path: str, body: dict[str, Any]) -> None:
    """Forge nothing."""


@contextmanager
def forging_proxy(target: str, request: Forge = leave, reply: Forge = leave) -> Iterator[str]:
    """The URL of a proxy to the server at ``target``, for the time of the context."""
    client = httpx.Client(base_url=target, trust_env=False)

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"
        wbufsize = -1  # head and body in one segment

        def forward(self) -> None:
            sent = self.rfile.read(int(self.headers.get("Content-Length", 0)))
            headers = {"Content-Type": self.headers.get("Content-Type", "application/json")}
            content = _forged(sent, self.path, request)
            got = client.request(self.command, self.path, content=content, headers=headers)
            body = _forged(got.content, self.path, reply)
            self.send_response(got.status_code)
            self.send_header("Content-Type", got.headers.get("Content-Type", "application/json"))
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        do_GET = do_POST = do_DELETE = forward

        def log_message(self, *_: object) -> None:
            """Say nothing."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, args=(0.05,))
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
        client.close()


def _forged(content: bytes, path: str, forge: Forge) -> bytes:
    try:
        body = json.loads(content)
    except ValueError:
        return content
    if not isinstance(body, dict):
        return content
    before = json.dumps(body)
    forge(path, body)
    return content if json.dumps(body) == before else json.dumps(body).encode()
