"""Requests of this process that alternate between several servers, counted for each session and server."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import count
from typing import Any

import httpx
import pytest

from surrogym_client.transport.connection import Connection
from surrogym_client.transport.stream import Stream

SESSION = re.compile(r"/v1/sessions/([^/]+)")


@dataclass
class Alternation:
    """Whose turn it is, and the number of requests by session and server.

    Args:
        urls: addresses of the servers. Each session alternates between them, and so do all other requests together.
    """

    urls: Sequence[str]
    requests: Counter[tuple[str, str]] = field(default_factory=Counter)
    _turns: dict[str, Iterator[int]] = field(default_factory=dict)

    def next(self, path: str) -> str:
        """Return the address of the server that gets the next request for a path, and count the request."""
        found = SESSION.search(path)
        session = found[1] if found else ""
        url = self.urls[next(self._turns.setdefault(session, count())) % len(self.urls)]
        self.requests[session, url] += 1
        return url

    def by_session(self) -> dict[str, tuple[int, ...]]:
        """Return the number of requests of each session at each server."""
        sessions = {session for session, _ in self.requests if session}
        return {session: tuple(self.requests[session, url] for url in self.urls) for session in sessions}


class AlternatingStream:
    """A stream to each server. The messages of the session alternate between them."""

    def __init__(self, alternation: Alternation, path: str, token: str | None, connect_seconds: float) -> None:
        self._alternation, self._path = alternation, path
        self._streams = {url: Stream(url + path, token, connect_seconds) for url in alternation.urls}

    def exchange(self, message: bytes, seconds: float) -> bytes:
        return self._streams[self._alternation.next(self._path)].exchange(message, seconds)

    def close(self) -> None:
        for stream in self._streams.values():
            stream.close()


@contextmanager
def alternating(urls: Sequence[str]) -> Iterator[Alternation]:
    """Let all requests to the first server, over HTTP and streams, alternate between the servers."""
    alternation, send = Alternation(urls), httpx.HTTPTransport.handle_request

    def handle_request(self: httpx.HTTPTransport, request: httpx.Request) -> httpx.Response:
        if str(request.url).startswith(urls[0]):
            target = httpx.URL(alternation.next(request.url.path))
            request.url = request.url.copy_with(host=target.host, port=target.port)
        return send(self, request)

    def stream_to(self: Connection, path: str) -> Any:
        return AlternatingStream(alternation, path, self._token, self.timeouts.connect)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(httpx.HTTPTransport, "handle_request", handle_request)
        patch.setattr(Connection, "stream_to", stream_to)
        yield alternation
