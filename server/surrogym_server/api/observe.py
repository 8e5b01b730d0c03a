"""Request ids, durations by route, and the log of requests.

Each request gets an id, which is in its reply, its problem body and its log lines. Requests that change something, and
refused requests, are logged with their sender.
"""

from __future__ import annotations

import logging
import re
import secrets
import time
from itertools import count

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from surrogym_server.api.auth import caller
from surrogym_server.api.headers import raw_header
from surrogym_server.api.problems import REQUEST_HEADER
from surrogym_server.engine.tallies import Durations
from surrogym_server.logs import REQUEST_ID
from surrogym_server.services.metrics import ProcessMetrics

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
