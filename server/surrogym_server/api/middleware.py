"""Middleware before the routes: request ids, durations by route, the log of requests, and refusals.

Each request gets an id, which is in its reply, its problem body and its log lines. Requests that change something, and
refused requests, are logged with their sender. Large bodies, unknown host names, and requests of other web sites are
refused.
"""

from __future__ import annotations

import logging
import re
import secrets
import time
from itertools import count
from urllib.parse import urlsplit

from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from surrogym_server.api.door import BODY_LIMIT, caller, raw_header
from surrogym_server.api.problems import REQUEST_HEADER, RETRY_AFTER_SECONDS, problem_response
from surrogym_server.engine.tallies import Durations
from surrogym_server.logs import REQUEST_ID
from surrogym_server.services.metrics import ProcessMetrics
from surrogym_shared.codes import Code

logger = logging.getLogger("surrogym_server.requests")

UNKNOWN_ROUTE = "unknown"
METHODS = frozenset({"GET", "POST", "PUT", "PATCH", "DELETE", "HEAD", "OPTIONS"})
CHANGING = frozenset({"POST", "PUT", "PATCH", "DELETE"})  # methods that are logged, except for the routes in FREQUENT
FREQUENT = frozenset(  # routes that are called very often and change nothing lasting
    {
        "/v1/sessions/{id}/reset",
        "/v1/sessions/{id}/step",
        "/v1/sessions/{id}/rollout",
        "/v1/surrogates/{name}/queries:claim",
        "/v1/surrogates/{name}/queries/{query_id}:renew",
        "/v1/surrogates/{name}/query_uncertainty",
        "/v1/surrogates/{name}/predict",
        "/v1/surrogates/{name}/imagine",
    }
)
# Number of characters of a path that are logged, because callers without a token may send very long paths.
MOST_PATH = 256
FAILED = 500  # status recorded for a request that ended before its reply began

_GIVEN = re.compile(r"[A-Za-z0-9._-]{1,64}")
_HEADER = REQUEST_HEADER.encode()
# Headers for browsers: pages of other web sites may not load a reply, and its media type is not guessed.
_FOR_BROWSERS = ((b"cross-origin-resource-policy", b"same-origin"), (b"x-content-type-options", b"nosniff"))
# Parts of request ids: a random prefix and a number. A new random id for each request would cost a system call.
_PROCESS, _NUMBERS = secrets.token_hex(4), count(1)


class Observed:
    """Outermost middleware: it gives each request an id, measures its duration, and logs it."""

    def __init__(self, app: ASGIApp, metrics: ProcessMetrics) -> None:
        self._app = app
        self._metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        id = _id_of(scope)
        # The id need not be reset, because each request has its own task. The handler of unexpected errors reads the
        # id later.
        REQUEST_ID.set(id)
        started, status = time.perf_counter(), FAILED
        headers = (*_FOR_BROWSERS, (_HEADER, id.encode()))

        async def identified(message: Message) -> None:
            nonlocal status
            if "headers" in message or message["type"] == "http.response.start":
                status = message.get("status", status)
                message["headers"] = [*message.get("headers", ()), *headers]
            await send(message)

        try:
            await self._app(scope, receive, identified)
        finally:
            if scope["type"] == "http" or status != FAILED:  # a WebSocket is only logged if it was refused
                self._note(scope, status, time.perf_counter() - started)

    def _note(self, scope: Scope, status: int, seconds: float) -> None:
        method = scope.get("method", "GET")  # the scope of a WebSocket has no method; its handshake is a GET
        method = method if method in METHODS else "other"
        route = getattr(scope.get("route"), "path", UNKNOWN_ROUTE)
        key = (method, route, status)
        durations = self._metrics.requests.get(key)
        if durations is None:
            durations = self._metrics.requests[key] = Durations()
        durations.observe(seconds)
        told = status >= 400 or (method in CHANGING and route not in FREQUENT)
        level = logging.WARNING if status >= FAILED else logging.INFO if told else logging.DEBUG
        if logger.isEnabledFor(level):
            path, who = scope["path"], caller(scope)
            path = path if len(path) <= MOST_PATH else f"{path[:MOST_PATH]}... ({len(path)} characters)"
            logger.log(level, "%s %s -> %d in %.1f ms, by %s", method, path, status, 1e3 * seconds, who)


def _id_of(scope: Scope) -> str:
    """Return the id that the caller gave a request in its header if it is valid, else a new id."""
    given = raw_header(scope, _HEADER).decode("latin-1")
    return given if given and _GIVEN.fullmatch(given) else f"{_PROCESS}{next(_NUMBERS):06x}"


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
