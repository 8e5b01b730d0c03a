"""Lines of claims that wait for work. The first in a line ask the database, and the others wait behind them."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable, Hashable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Generic, TypeVar

from surrogym_server.services.notices import Listener, Notices

T = TypeVar("T")

FIRST = 4  # most claims of a line that ask the database at a time
LOOK_SECONDS = 2.0  # time between two checks whether the caller has closed its connection

Present = Callable[[], Awaitable[None]]  # raises if the caller has closed its connection


class _Line(Generic[T]):
    """Claims for the same work. ``answer`` is the last answer without work, to a question asked at ``version``.

    The line listens to notices as long as it exists: while ``heard.version`` equals ``version``, the answer still
    holds.
    """

    def __init__(self, listening: ExitStack, heard: Listener) -> None:
        self.inside = 0
        self.listening = listening
        self.heard = heard
        self.first = asyncio.Semaphore(FIRST)
        self.answer: T | None = None
        self.version: int | None = None


class Lines(Generic[T]):
    """Claims that wait, grouped by the work that they ask for.

    Args:
        notices: tell that a surrogate has changed. Whatever makes work claimable posts a notice or appends an event.
        has_work: whether an answer ends the wait because it has work, which belongs to this claim alone.
        ends: whether an answer without work ends the wait, given the answer known before it.
    """

    def __init__(
        self, notices: Notices, has_work: Callable[[T], bool], ends: Callable[[T, T], bool] = lambda *_: False
    ) -> None:
        self._notices = notices
        self._has_work = has_work
        self._ends = ends
        self._lines: dict[Hashable, _Line[T]] = {}

    async def claim(
        self, surrogate: str, kind: Hashable, ask: Callable[[], T], seconds: float, present: Present | None = None
    ) -> T:
        """Ask for work, and wait for it up to ``seconds``. Returns an answer with work, or the last answer without any.

        Args:
            surrogate: name of the surrogate, whose notices tell of new work.
            kind: claims of equal kinds can take the same work.
            ask: asks the database, in a thread.
            present: raises if the caller has closed its connection; called before each question.
        """
        deadline = time.monotonic() + seconds
        with self._place(surrogate, kind) as line:
            before = line.answer
            if not await _acquired(line.first, seconds):
                return await self._answer(line, ask)
            try:
                with self._notices.listen(surrogate) as listener:
                    while True:
                        if present is not None:
                            await present()
                        answer = await self._answer(line, ask)
                        before, left = before or answer, deadline - time.monotonic()
                        over = self._notices.closing or left <= 0
                        if over or self._has_work(answer) or self._ends(before, answer):
                            return answer
                        await listener.wait(min(left, LOOK_SECONDS))
            finally:
                line.first.release()

    async def _answer(self, line: _Line[T], ask: Callable[[], T]) -> T:
        """Return the line's last answer if nothing has happened since; else ask again."""
        if line.answer is not None and line.version == line.heard.version:
            return line.answer
        version, answer = line.heard.version, await asyncio.to_thread(ask)
        if not self._has_work(answer):
            line.answer, line.version = answer, version
        return answer

    @contextmanager
    def _place(self, surrogate: str, kind: Hashable) -> Iterator[_Line[T]]:
        key = (surrogate, kind)
        if key not in self._lines:
            listening = ExitStack()
            self._lines[key] = _Line(listening, listening.enter_context(self._notices.listen(surrogate)))
        line = self._lines[key]
        line.inside += 1
        try:
            yield line
        finally:
            line.inside -= 1
            if not line.inside:
                del self._lines[key]
                line.listening.close()


async def _acquired(turn: asyncio.Semaphore, seconds: float) -> bool:
    """Wait for a turn, at most ``seconds``."""
    try:
        async with asyncio.timeout(seconds):
            return await turn.acquire()
    except TimeoutError:
        return False
