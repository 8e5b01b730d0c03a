"""Queues of claims that wait for work. The first few of a queue ask the database, and the others wait behind them."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable, Hashable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Generic, TypeVar

from surrogym_server.services.notices import Listener, Notices

T = TypeVar("T")

FIRST = 4  # at most this many waiting requests for the same kind of work ask the database at the same time
LOOK_SECONDS = 2.0  # a waiting request checks this often (in seconds) whether its client has closed the connection

Present = Callable[[], Awaitable[None]]  # function that raises an error if the client has closed its connection


class _Queue(Generic[T]):
    """Claims (requests for work) that wait for the same kind of work.

    ``heard`` listens to notices that work may be available. ``answer`` is the last answer that contained no work, and
    ``version`` the number of the last notice before that answer. If ``heard.version`` still equals ``version``, no
    notice has come since, so the answer is still valid.
    """

    def __init__(self, listening: ExitStack, heard: Listener) -> None:
        self.inside = 0
        self.listening = listening
        self.heard = heard
        self.first = asyncio.Semaphore(FIRST)
        self.answer: T | None = None
        self.version: int | None = None


class ClaimQueues(Generic[T]):
    """Claims (requests for work) that wait for work, in one queue for each kind of work.

    Args:
        notices: notices of changes of a surrogate. Code that makes work available must post a notice or append an
            event.
        has_work: returns whether an answer contains work; such an answer belongs to one claim and ends its wait.
        ends: returns whether an answer without work ends the wait, given an earlier answer and the present one.
    """

    def __init__(
        self, notices: Notices, has_work: Callable[[T], bool], ends: Callable[[T, T], bool] = lambda *_: False
    ) -> None:
        self._notices = notices
        self._has_work = has_work
        self._ends = ends
        self._queues: dict[Hashable, _Queue[T]] = {}

    async def claim(
        self, surrogate: str, kind: Hashable, ask: Callable[[], T], seconds: float, present: Present | None = None
    ) -> T:
        """Ask for work, and wait for it at most ``seconds``. Return the first answer that contains work, or the last
        answer if none did.

        Args:
            surrogate: name of the surrogate whose notices announce new work.
            kind: kind of work; claims of the same kind wait in one queue.
            ask: asks the database for work; called in a thread.
            seconds: longest wait.
            present: raises if the caller has closed its connection; called before each call of ``ask``.
        """
        deadline = time.monotonic() + seconds
        with self._place(surrogate, kind) as queue:
            before = queue.answer
            if not await _acquired(queue.first, seconds):
                return await self._answer(queue, ask)
            try:
                with self._notices.listen(surrogate) as listener:
                    while True:
                        if present is not None:
                            await present()
                        answer = await self._answer(queue, ask)
                        before, left = before or answer, deadline - time.monotonic()
                        over = self._notices.closing or left <= 0
                        if over or self._has_work(answer) or self._ends(before, answer):
                            return answer
                        await listener.wait(min(left, LOOK_SECONDS))
            finally:
                queue.first.release()

    async def _answer(self, queue: _Queue[T], ask: Callable[[], T]) -> T:
        """Return the last answer without work that any claim in ``queue`` got, if no notice has come since; otherwise
        ask the database by calling ``ask``."""
        if queue.answer is not None and queue.version == queue.heard.version:
            return queue.answer
        version, answer = queue.heard.version, await asyncio.to_thread(ask)
        if not self._has_work(answer):
            queue.answer, queue.version = answer, version
        return answer

    @contextmanager
    def _place(self, surrogate: str, kind: Hashable) -> Iterator[_Queue[T]]:
        key = (surrogate, kind)
        if key not in self._queues:
            listening = ExitStack()
            self._queues[key] = _Queue(listening, listening.enter_context(self._notices.listen(surrogate)))
        queue = self._queues[key]
        queue.inside += 1
        try:
            yield queue
        finally:
            queue.inside -= 1
            if not queue.inside:
                del self._queues[key]
                queue.listening.close()


async def _acquired(turn: asyncio.Semaphore, seconds: float) -> bool:
    """Acquire a semaphore within ``seconds``, and return whether that succeeded."""
    try:
        async with asyncio.timeout(seconds):
            return await turn.acquire()
    except TimeoutError:
        return False
