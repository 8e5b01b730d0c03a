"""Work that takes long, for callers who only look: a few at once, a short queue, and nothing for who has gone."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import TypeVar

from fastapi import Request
from starlette.requests import ClientDisconnect

from surrogym_server.errors import Overloaded

T = TypeVar("T")

AT_WORK, WAITING = 2, 32


class Turns:
    """Lets ``AT_WORK`` requests work, each in a thread, and ``WAITING`` wait for their turn."""

    def __init__(self) -> None:
        self._inside = 0
        self._turn = asyncio.Semaphore(AT_WORK)

    async def take(self, request: Request, work: Callable[[], T]) -> T:
        """The result of ``work`` when its turn has come.

        Raises:
            Overloaded: too many wait.
            ClientDisconnect: the caller has gone meanwhile; nothing was computed.
        """
        if self._inside >= AT_WORK + WAITING:
            raise Overloaded(f"expected at most {AT_WORK + WAITING} predictions at work or waiting, got one more")
        self._inside += 1
        try:
            async with self._turn:
                if await request.is_disconnected():
                    raise ClientDisconnect
                return await asyncio.to_thread(work)
        finally:
            self._inside -= 1
