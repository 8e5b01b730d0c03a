"""Streams of a surrogate's events, which wait for new events."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from typing import TypeVar

from surrogym_server.errors import SurrogymError, Unavailable, UnknownSurrogate
from surrogym_server.services.notices import Notices
from surrogym_server.storage.port import Storage
from surrogym_server.storage.records import EventRecord

T = TypeVar("T")

SILENCE_SECONDS = 15.0
CHANGE_SECONDS = 0.2  # shortest time between two pages of events, and between two results of ``changes``
PAGE = 200
RETRY_SECONDS = 2.0
READING = 2  # reads of the database at a time; without a limit, many new streams would occupy all threads


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
        self._shared: dict[str, tuple[tuple[int, int], asyncio.Task[Page]]] = {}  # last page of each surrogate

    async def newest(self, name: str) -> int:
        """Return the id of a surrogate's last event, 0 if it has none. Raises ``UnknownSurrogate``."""
        newest = await self._read(lambda: self._storage.events.newest([name]))
        if name not in newest:
            raise UnknownSurrogate(f"expected the name of a surrogate, got {name!r}, which does not exist")
        return newest[name]

    async def changes(self) -> AsyncIterator[bool]:
        """Yield True after events of any surrogate, and False after ``SILENCE_SECONDS`` without one, until the server
        stops."""
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
                    except Unavailable:  # the stream continues once the storage is back
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
        """Return a surrogate's next events with an id above ``after``.

        Streams share a page if they request the same events and ``version``, the number of the last notice, is equal.
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
