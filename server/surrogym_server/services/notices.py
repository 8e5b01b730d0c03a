"""Notices that a surrogate has changed. They wake waiting requests in this process and in other servers of the
database."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import chain, islice

from surrogym_server.storage.sql.events import Announcements

# At most this many listeners are woken in one iteration of the event loop. In between it can answer other requests.
AT_ONCE = 50


class Listener:
    """A subscriber to notices that a surrogate has changed. If a notice comes between two calls of ``wait``, the second
    call returns at once."""

    def __init__(self, audience: Audience) -> None:
        self._audience = audience
        self._event = asyncio.Event()

    @property
    def version(self) -> int:
        """Number of the last notice to this listener. If the number has not changed, no notice has come meanwhile."""
        return self._audience.version

    def wake(self) -> None:
        self._event.set()

    async def wait(self, seconds: float) -> bool:
        """Wait at most ``seconds`` for a notice, and return whether one has come. A notice that came since the last
        call counts."""
        with suppress(TimeoutError):
            async with asyncio.timeout(seconds):  # not asyncio.wait_for, which can lose a cancellation in Python 3.11
                await self._event.wait()
        noticed = self._event.is_set()
        self._event.clear()
        return noticed


class Audience:
    """The listeners to one surrogate or to all surrogates, and the number of their last notice."""

    def __init__(self, version: int) -> None:
        self.version = version
        self.listeners: dict[Listener, None] = {}  # the keys are the listeners: a set that keeps their order


class Notices:
    """Delivers notices of changed surrogates to listeners.

    ``post`` may be called from any thread, all other methods only from the thread of the event loop.

    Args:
        announcements: carry notices between the servers of a database; None for a single server.
    """

    def __init__(self, announcements: Announcements | None = None) -> None:
        self._announcements = announcements or Announcements()
        self._loop = asyncio.get_running_loop()
        self._audiences: dict[str, Audience] = {}
        self._everything = Audience(0)
        self._newest: dict[str, int | None] = {}  # id of each surrogate's newest event at the last call of ``compare``
        self._count = 0
        self.closing = False
        self._announcements.listen(self._hear)

    def post(self, surrogate: str) -> None:
        """Wake the listeners to this surrogate and the listeners to all surrogates, in every server that uses the
        database."""
        self._hear(surrogate)
        self._announcements.announce(surrogate)

    def close(self) -> None:
        """Wake all listeners, because the server stops; ``closing`` becomes True."""
        self.closing = True
        self._wake_all()

    @contextmanager
    def listen(self, surrogate: str | None = None) -> Iterator[Listener]:
        """Return a context with a listener to notices of one surrogate, or of all surrogates if ``surrogate`` is
        None."""
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
        """Names of the surrogates to which at least one listener listens. Listeners to all surrogates don't count."""
        return [*self._audiences]

    def compare(self, newest: dict[str, int]) -> None:
        """Wake the listeners to the surrogates whose newest event has changed since the last comparison.

        So the listeners are woken even if a notice of another server was lost.

        Args:
            newest: id of the newest event of each surrogate in ``listened`` that exists.
        """
        before, self._newest = self._newest, {name: newest.get(name) for name in self._audiences}
        for name, id in self._newest.items():
            if name not in before or before[name] != id:
                self._wake(name)

    def _hear(self, surrogate: str | None) -> None:
        """Wake the listeners of this process to ``surrogate``. None means that notices may have been lost, and wakes
        all listeners."""
        with suppress(RuntimeError):  # raised if the event loop is closed: no listener waits any more
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
