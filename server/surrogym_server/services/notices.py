"""Notices of changes of a surrogate, which wake those who wait in this process and in other servers of the database."""

from __future__ import annotations

import asyncio
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import chain

from surrogym_server.storage.announcements import Alone, Announcements


class Listener:
    """A waiting service. A notice that comes while it does not wait is remembered."""

    def __init__(self) -> None:
        self._event = asyncio.Event()

    def wake(self) -> None:
        self._event.set()

    async def wait(self, seconds: float) -> bool:
        """Wait for the next notice since the last wait, at most ``seconds``. Returns whether there was one."""
        with suppress(TimeoutError):
            async with asyncio.timeout(seconds):  # wait_for of Python 3.11 can swallow a cancellation
                await self._event.wait()
        noticed = self._event.is_set()
        self._event.clear()
        return noticed


class Notices:
    """Listeners by surrogate. ``post`` may be called from any thread, the rest from the event loop's.

    Args:
        announcements: of the database, which carry notices between its servers.
    """

    def __init__(self, announcements: Announcements | None = None) -> None:
        self._announcements = announcements or Alone()
        self._loop = asyncio.get_running_loop()
        self._listeners: defaultdict[str, set[Listener]] = defaultdict(set)
        self._everything: set[Listener] = set()
        self.closing = False
        self._announcements.listen(self._hear)

    def post(self, surrogate: str) -> None:
        """Wake the listeners to a surrogate, and the listeners to all, in every server of the database."""
        self._hear(surrogate)
        self._announcements.announce(surrogate)

    def close(self) -> None:
        """Wake everybody for good, because the server stops."""
        self.closing = True
        self._wake_all()

    @contextmanager
    def listen(self, surrogate: str | None = None) -> Iterator[Listener]:
        """Listen to one surrogate, or to all, within the context."""
        listener = Listener()
        listeners = self._everything if surrogate is None else self._listeners[surrogate]
        listeners.add(listener)
        try:
            yield listener
        finally:
            listeners.discard(listener)
            if surrogate is not None and not listeners:
                self._listeners.pop(surrogate, None)

    def _hear(self, surrogate: str | None) -> None:
        """Wake in this process; None wakes everybody, as notices may have been missed."""
        with suppress(RuntimeError):  # the loop has ended, and nobody listens any more
            if surrogate is None:
                self._loop.call_soon_threadsafe(self._wake_all)
            else:
                self._loop.call_soon_threadsafe(self._wake, surrogate)

    def _wake_all(self) -> None:
        for listener in (*self._everything, *chain.from_iterable(self._listeners.values())):
            listener.wake()

    def _wake(self, surrogate: str) -> None:
        for listener in (*self._listeners.get(surrogate, ()), *self._everything):
            listener.wake()
