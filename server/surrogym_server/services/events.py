"""Events of a surrogate, as a stream that waits for new ones."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

from surrogym_server.errors import Unavailable, UnknownSurrogate
from surrogym_server.services.notices import Notices
from surrogym_server.storage.port import Storage
from surrogym_server.storage.records import EventRecord

POLL_SECONDS = 2.0
SILENCE_SECONDS = 15.0
CHANGE_SECONDS = 0.2  # at least, between two notices that something has changed
PAGE = 1_000


class EventService:
    def __init__(self, storage: Storage, notices: Notices) -> None:
        self._storage = storage
        self._notices = notices

    def newest(self, name: str) -> int:
        """The id of the last event, 0 before the first. Raises ``UnknownSurrogate``."""
        after = 0
        while page := self._storage.events.list(name, after, PAGE):
            after = page[-1].id
        return after

    async def changes(self) -> AsyncIterator[bool]:
        """Yield True after an event of any surrogate, and False after a silence, until the server stops."""
        with self._notices.listen() as listener:
            while not self._notices.closing:
                changed = await listener.wait(SILENCE_SECONDS)
                if not self._notices.closing:
                    yield changed
                    await asyncio.sleep(CHANGE_SECONDS)

    async def follow(self, name: str, after: int) -> AsyncIterator[EventRecord | None]:
        """Yield the events with an id above ``after``, and None after a silence, until the surrogate is deleted or the
        server stops."""
        silent = 0.0
        with self._notices.listen(name) as listener:
            while not self._notices.closing:
                try:
                    page = await asyncio.to_thread(self._storage.events.list, name, after, PAGE)
                except UnknownSurrogate:
                    return
                except Unavailable:  # it continues when storage is back
                    page = []
                for event in page:
                    yield event
                    after = event.id
                silent = 0.0 if page else silent + POLL_SECONDS
                if silent >= SILENCE_SECONDS:
                    silent = 0.0
                    yield None
                if not page:
                    await listener.wait(POLL_SECONDS)
