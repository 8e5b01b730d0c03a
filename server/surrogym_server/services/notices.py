"""Notices of changes of a surrogate, which wake those who wait in this process and in other servers of the database."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import chain, islice

from surrogym_server.storage.announcements import Alone, Announcements

AT_ONCE = 50  # most listeners woken in one turn of the event loop; other requests are answered between the turns


class Listener:
    """A waiting service. A notice that comes while it does not wait is remembered."""

    def __init__(self, audience: Audience) -> None:
        self._audience = audience
        self._event = asyncio.Event()

    @property
    def version(self) -> int:
        """Number of the last notice that this listener could hear. If it is the same at two times, nothing has happened
        in between."""
        return self._audience.version

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


class Audience:
    """The listeners to one surrogate, or to all surrogates."""

    def __init__(self, version: int) -> None:
        self.version = version
        self.listeners: dict[Listener, None] = {}  # in the order in which they came


class Notices:
    """Listeners by surrogate. ``post`` may be called from any thread, all other methods from the event loop's thread.

    Args:
        announcements: of the database, which carry notices between its servers.
    """

    def __init__(self, announcements: Announcements | None = None) -> None:
        self._announcements = announcements or Alone()
        self._loop = asyncio.get_running_loop()
        self._audiences: dict[str, Audience] = {}
        self._everything = Audience(0)
        self._newest: dict[str, int | None] = {}  # id of the newest event at the last look
        self._count = 0
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
        """Return a context that listens to one surrogate, or to all surrogates."""
        audience = self._everything
        if surrogate is not None:
            audience = self._audiences.setdefault(surrogate, Audience(self._next()))
        listener = Listener(audience)
        audience.listeners[listener] = None
        try:
            yield listener
        finally:
            del audience.listeners[listener]
            if surrogate is not None and not audience.listeners and self._audiences.get(surrogate) is audience:
                del self._audiences[surrogate]

    @property
    def listened(self) -> list[str]:
        """Names of the surrogates that somebody listens to."""
        return [*self._audiences]

    def compare(self, newest: dict[str, int]) -> None:
        """Wake the listeners to the surrogates that have changed since the last comparison.

        A notice of another server may be lost, and so may the first change of a surrogate that nobody listened to.

        Args:
            newest: id of the newest event of each surrogate that was ``listened`` to and exists.
        """
        before, self._newest = self._newest, {name: newest.get(name) for name in self._audiences}
        for name, id in self._newest.items():
            if name not in before or before[name] != id:
                self._wake(name)

    def _hear(self, surrogate: str | None) -> None:
        """Wake the listeners of this process to a surrogate. None wakes all listeners, because notices may have been
        lost."""
        with suppress(RuntimeError):  # the loop has ended, and nobody listens any more
            if surrogate is None:
                self._loop.call_soon_threadsafe(self._wake_all)
            else:
                self._loop.call_soon_threadsafe(self._wake, surrogate)

    def _wake_all(self) -> None:
        self._wake_these(self._everything, *self._audiences.values())

    def _wake(self, surrogate: str) -> None:
        audience = self._audiences.get(surrogate)
        self._wake_these(self._everything, *(() if audience is None else (audience,)))

    def _wake_these(self, *audiences: Audience) -> None:
        for audience in audiences:
            audience.version = self._next()
        self._wake_some(iter([*chain.from_iterable(audience.listeners for audience in audiences)]))

    def _wake_some(self, listeners: Iterator[Listener]) -> None:
        some = [*islice(listeners, AT_ONCE)]
        for listener in some:
            listener.wake()
        if len(some) == AT_ONCE:
            self._loop.call_soon(self._wake_some, listeners)

    def _next(self) -> int:
        self._count += 1
        return self._count
