"""Streams of a surrogate's events, which wait for new events."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from typing import TypeVar

from surrogym_server.errors import SurrogymError, Unavailable, UnknownSurrogate
from surrogym_server.services.notices import Notices
from surrogym_server.storage.records import EventRecord
from surrogym_server.storage.sql import Storage

T = TypeVar("T")

SILENCE_SECONDS = 15.0
CHANGE_SECONDS = 0.2  # after sending events, a stream waits this long before it sends more, to send several together
PAGE = 200
RETRY_SECONDS = 2.0
READING = 2  # at most this many threads read events from the database, so that many streams don't occupy all threads


@dataclass(frozen=True, eq=False)
class Page:
    """Consecutive events of a surrogate. All streams that wait for the same events share one page."""

    events: tuple[EventRecord, ...]


class EventService:
    """Streams of events. When new events come, they are read once from the database for all streams that wait for the
    same surrogate."""

    def __init__(self, storage: Storage, notices: Notices) -> None:
        self._storage = storage
        self._notices = notices
        self._turn = asyncio.Semaphore(READING)
        # For each surrogate, by name: the page of events that was read last, for all streams that need it; and (id of
        # the event after which it begins, number of the latest notice when it was read).
        self._shared: dict[str, tuple[tuple[int, int], asyncio.Task[Page]]] = {}

    async def newest(self, name: str) -> int:
        """Return the id of a surrogate's last event, 0 if it has none. Raises ``UnknownSurrogate``."""
        newest = await self._read(lambda: self._storage.events.newest([name]))
        if name not in newest:
            raise UnknownSurrogate(
                f"expected the name of a surrogate, got {name!r}, which does not exist: correct or register it"
            )
        return newest[name]

    async def changes(self) -> AsyncIterator[bool]:
        """Yield True when events of any surrogate have come, and False after each ``SILENCE_SECONDS`` without an event,
        until the server stops."""
        with self._notices.listen() as listener:
            while not self._notices.closing:
                changed = await listener.wait(SILENCE_SECONDS)
                if not self._notices.closing:
                    yield changed
                    await asyncio.sleep(CHANGE_SECONDS)

    async def follow(self, name: str, after: int) -> AsyncIterator[Page | None]:
        """Yield a surrogate's events with an id above ``after``, page by page, until the surrogate is deleted or the
        server stops.

        Yields None after ``SILENCE_SECONDS`` without an event.
        """
        try:
            with self._notices.listen(name) as listener:
                while not self._notices.closing:
                    version = listener.version
                    try:
                        page = await self._page(name, after, version)
                    except UnknownSurrogate:
                        return
                    except Unavailable:  # the stream waits, and continues when the storage answers again
                        await asyncio.sleep(RETRY_SECONDS)
                        continue
                    if page.events:
                        yield page
                        after = page.events[-1].id
                        if len(page.events) == PAGE:
                            continue
                        await asyncio.sleep(CHANGE_SECONDS)
                    while version == listener.version and not self._notices.closing:
                        if not await listener.wait(SILENCE_SECONDS):
                            yield None
        finally:
            if name not in self._notices.listened:
                self._shared.pop(name, None)

    async def _page(self, name: str, after: int, version: int) -> Page:
        """Return the next events of the surrogate ``name`` with an id above ``after``, at most ``PAGE``.

        ``version`` is the number of the last notice that the stream has got. Streams with equal arguments share one
        read of the database.
        """
        position, task = self._shared.get(name, (None, None))
        if task is None or position != (after, version):
            task = asyncio.create_task(self._read(lambda: Page(tuple(self._storage.events.list(name, after, PAGE)))))
            self._shared[name] = (after, version), task
        try:
            return await asyncio.shield(task)
        except SurrogymError:
            self._shared.pop(name, None)
            raise

    async def _read(self, read: Callable[[], T]) -> T:
        async with self._turn:
            return await asyncio.to_thread(read)
