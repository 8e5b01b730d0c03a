"""Guards before the routes: the size of a body, and the name this server was called by."""

from __future__ import annotations

from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from surrogym_server.api.headers import raw_header
from surrogym_server.api.problems import RETRY_AFTER_SECONDS, problem_response
from surrogym_shared.codes import Code


class BodyLimit:
    """Refuses bodies of more than ``max_bytes``, announced or chunked, and of more in all requests at once."""

    def __init__(self, app: ASGIApp, max_bytes: int, max_together: int) -> None:
        self._app = app
        self._max_bytes = max_bytes
        self._max_together = max_together
        self._together = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        announced = raw_header(scope, b"content-length")
        if announced.isdigit() and int(announced) > self._max_bytes:
            response = problem_response(Code.TOO_LARGE, self._detail(f"{announced.decode()} bytes"))
            await response(scope, receive, send)
            return
        received = 0

        async def counted() -> Message:
            nonlocal received
            message = await receive()
            size = len(message.get("body", b""))
            received += size
            self._together += size
            if received > self._max_bytes:
                raise HTTPException(413, self._detail("more"))
            if self._together > self._max_together:
                detail = f"expected bodies of at most {self._max_together} bytes in all requests at once, got more"
                raise HTTPException(429, detail, {"retry-after": RETRY_AFTER_SECONDS})
            return message

        try:
            await self._app(scope, counted, send)
        finally:
            self._together -= received

    def _detail(self, got: str) -> str:
        return f"expected a body of at most {self._max_bytes} bytes, got {got}"


class KnownHosts:
    """Refuses other host names: a page elsewhere whose name was pointed at this machine (DNS rebinding)."""

    def __init__(self, app: ASGIApp, hosts: frozenset[str]) -> None:
        self._app = app
        self._hosts = hosts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan" or (host := _host(scope)) in self._hosts:
            await self._app(scope, receive, send)
            return
        detail = f"expected the host name to be one of {sorted(self._hosts)}, got {host!r}"
        await problem_response(Code.FORBIDDEN, detail)(scope, receive, send)


def _host(scope: Scope) -> str:
    header = raw_header(scope, b"host").decode("latin-1").lower()
    if header.startswith("["):
        return header[1:].partition("]")[0]
    return header.partition(":")[0]
