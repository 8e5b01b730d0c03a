"""Limits on the number of requests of one kind that run or wait."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from fastapi import Request
from starlette.requests import ClientDisconnect

from surrogym_server.api.auth import bearer_token
from surrogym_server.errors import Overloaded

T = TypeVar("T")

MAX_WAITING = 2_000  # largest number of waiting requests of one kind with one token: an eighth of all connections


class ConcurrencyLimit:
    """Limit on the requests of one kind: at most ``at_work`` of them run at a time, each in a thread, and at most
    ``waiting`` more wait."""

    def __init__(self, what: str, at_work: int, waiting: int) -> None:
        """Set the limits. ``what`` names the requests in error messages, such as "predictions"."""
        self._what = what
        self._most = at_work + waiting
        self._inside = 0
        self._turn = asyncio.Semaphore(at_work)

    async def take(self, request: Request, work: Callable[[], T]) -> T:
        """Run ``work`` in a thread as soon as fewer than ``at_work`` requests run, and return its result.

        Raises:
            Overloaded: too many requests wait.
            ClientDisconnect: the caller has disconnected during the wait; ``work`` was not run.
        """
        if self._inside >= self._most:
            raise Overloaded(
                f"expected at most {self._most} {self._what} at work or waiting, got one more: try again later"
            )
        self._inside += 1
        try:
            async with self._turn:
                await require_present(request)
                return await asyncio.to_thread(work)
        finally:
            self._inside -= 1


class Waiting:
    """Limit on the number of requests of each token that wait for something to happen. Each waiting request takes
    memory."""

    def __init__(self, what: str, most: int = MAX_WAITING) -> None:
        """Set the limit ``most``. ``what`` names the requests in error messages, such as "open streams of events"."""
        self._what = what
        self._most = most
        self._by_token = Counter[str | None]()

    def require_room(self, request: Request) -> None:
        """Raise ``Overloaded`` if the token of a request has the largest allowed number of waiting requests."""
        if self._by_token[bearer_token(request.scope)] >= self._most:
            raise Overloaded(f"expected at most {self._most} {self._what} with one token, got one more: close some")

    @contextmanager
    def count(self, request: Request) -> Iterator[None]:
        """Return a context during which a request counts as waiting."""
        token = bearer_token(request.scope)
        self._by_token[token] += 1
        try:
            yield
        finally:
            self._by_token[token] -= 1


async def require_present(request: Request) -> None:
    """Raise ``ClientDisconnect`` if the caller has closed its connection."""
    if await request.is_disconnected():
        raise ClientDisconnect
