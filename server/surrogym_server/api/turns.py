"""Turns for long work of read-only requests: a few run at once, a few wait, and nothing is computed for a caller who
has gone."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import TypeVar

from fastapi import Request
from starlette.requests import ClientDisconnect

from surrogym_server.errors import Overloaded

T = TypeVar("T")


class Turns:
    """Limit on requests of one kind: ``at_work`` run at once, each in a thread, and ``waiting`` more wait for their
    turn."""

    def __init__(self, what: str, at_work: int, waiting: int) -> None:
        """``what`` names the requests, for the message of a refusal."""
        self._what = what
        self._most = at_work + waiting
        self._inside = 0
        self._turn = asyncio.Semaphore(at_work)

    async def take(self, request: Request, work: Callable[[], T]) -> T:
        """Do ``work`` when its turn has come, and return its result.

        Raises:
            Overloaded: too many requests wait.
            ClientDisconnect: the caller has gone meanwhile; nothing was computed.
        """
        if self._inside >= self._most:
            raise Overloaded(f"expected at most {self._most} {self._what} at work or waiting, got one more")
        self._inside += 1
        try:
            async with self._turn:
                if await request.is_disconnected():
                    raise ClientDisconnect
                return await asyncio.to_thread(work)
        finally:
            self._inside -= 1
