"""Middleware before the routes that refuses large bodies, unknown host names, and requests of other web sites."""

from __future__ import annotations

from urllib.parse import urlsplit

from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from surrogym_server.api.headers import raw_header
from surrogym_server.api.problems import RETRY_AFTER_SECONDS, problem_response
from surrogym_shared.codes import Code

BODY_LIMIT = "surrogym.body_limit"  # key in the ASGI scope: largest size of this body in bytes, set by ``api.door``
SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})
# Values of the header Sec-Fetch-Site for programs (no header), the server's own pages, and an address typed by a
# person.
OWN_SITE = (b"", b"same-origin", b"none")


class BodyLimit:
    """Middleware that refuses a request if its body is larger than the limit of its route, or if the bodies of all
    running requests together are larger than ``max_together`` bytes."""

    def __init__(self, app: ASGIApp, max_together: int) -> None:
        self._app = app
        self._max_together = max_together
        self._together = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        received = 0

        async def counted() -> Message:
            nonlocal received
            message = await receive()
            limit = scope.get(BODY_LIMIT)
            if limit is None:  # the route reads no body, so the bytes are dropped
                return {**message, "body": b""} if "body" in message else message
            size = len(message.get("body", b""))
            received += size
            self._together += size
            if received > limit:
                raise HTTPException(413, f"expected a body of at most {limit} bytes, got more: send less at a time")
            if self._together > self._max_together:
                detail = (
                    f"expected bodies of at most {self._max_together} bytes in all requests at once, got more: try "
                    "again later"
                )
                raise HTTPException(429, detail, {"retry-after": RETRY_AFTER_SECONDS})
            return message

        try:
            await self._app(scope, counted, send)
        finally:
            self._together -= received


class KnownHosts:
    """Middleware that refuses requests to a host name not in ``hosts``, against DNS rebinding.

    In such an attack, a web site makes its own host name point to this machine.
    """

    def __init__(self, app: ASGIApp, hosts: frozenset[str]) -> None:
        self._app = app
        self._hosts = hosts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan" or (host := _host(scope)) in self._hosts:
            await self._app(scope, receive, send)
            return
        detail = f"expected the host name of the request to be one of {sorted(self._hosts)}, got {host!r}"
        await problem_response(Code.FORBIDDEN, detail)(scope, receive, send)


class OwnPages:
    """Middleware that refuses a request from a page of another web site, if the request could change something or open
    a stream.

    A browser names the page's site in ``Origin``, and its relation to this server in ``Sec-Fetch-Site``. Programs send
    neither header.
    """

    def __init__(self, app: ASGIApp, public_url: str | None) -> None:
        """Wrap ``app``. ``public_url`` is the address of this server for browsers, if it is behind a proxy."""
        self._app = app
        self._public = None if public_url is None else origin_of(public_url)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        kind = scope["type"]
        changes = kind == "websocket" or (kind == "http" and scope["method"] not in SAFE_METHODS)
        if changes and (page := self._foreign_page(scope)):
            detail = f"expected a page of this server, got {page}; behind a proxy set SURROGYM_PUBLIC_URL"
            await problem_response(Code.FORBIDDEN, detail)(scope, receive, send)
            return
        await self._app(scope, receive, send)

    def _foreign_page(self, scope: Scope) -> str | None:
        """Describe the page that sent a request, if it belongs to another web site; None otherwise."""
        origin = raw_header(scope, b"origin").decode("latin-1").lower()
        if origin and origin not in (_called(scope), self._public):
            return f"one of {origin!r}"
        site = raw_header(scope, b"sec-fetch-site")
        if site not in OWN_SITE:
            return f"one of another site ({site.decode('latin-1')!r})"
        return None


def origin_of(url: str) -> str:
    """Return scheme, host and port of a URL in the form of the header ``Origin``."""
    parts = urlsplit(url.lower())
    default = {"http": 80, "https": 443}.get(parts.scheme)
    host = f"[{parts.hostname}]" if ":" in (parts.hostname or "") else parts.hostname
    return f"{parts.scheme}://{host}" + ("" if parts.port in (None, default) else f":{parts.port}")


def _called(scope: Scope) -> str:
    """Return the origin (scheme, host, port) to which a request was sent."""
    scheme = {"ws": "http", "wss": "https"}.get(scope["scheme"], scope["scheme"])
    return f"{scheme}://{raw_header(scope, b'host').decode('latin-1').lower()}"


def _host(scope: Scope) -> str:
    header = raw_header(scope, b"host").decode("latin-1").lower()
    if header.startswith("["):
        return header[1:].partition("]")[0]
    return header.partition(":")[0]
