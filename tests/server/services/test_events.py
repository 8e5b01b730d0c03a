"""Streams of events: those of one surrogate share what is read for them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import pytest

from surrogym_server.services.events import EventService, Page
from surrogym_server.services.notices import Notices
from surrogym_server.storage.sql import Storage

NAME = "pendulum"

PATIENCE = 60.0


async def until(holds: Callable[[], bool]) -> None:
    while not holds():
        await asyncio.sleep(0.01)


@pytest.mark.parametrize("streams", [1, 100])
def test_event_streams_of_one_surrogate_share_each_database_read(
    storage: Storage, monkeypatch: pytest.MonkeyPatch, streams: int
):
    reads = []
    stored = storage.events.list

    def counted(*arguments: object) -> object:
        page = stored(*arguments)  # type: ignore[arg-type]
        reads.append(arguments)  # once it has ended, so that what is reported afterwards needs another one
        return page

    monkeypatch.setattr(storage.events, "list", counted)

    async def run() -> None:
        notices = Notices()
        service = EventService(storage, notices)
        after = await service.newest(NAME)

        async def first() -> Page | None:
            async for page in service.follow(NAME, after):
                return page
            return None

        tasks = [asyncio.create_task(first()) for _ in range(streams)]
        await asyncio.wait_for(until(lambda: len(reads) > 0), PATIENCE)
        await asyncio.sleep(0.3)
        assert len(reads) == 1
        storage.ledger.report(NAME, 5, key="k")
        notices.post(NAME)
        pages = await asyncio.wait_for(asyncio.gather(*tasks), PATIENCE)
        assert len({id(page) for page in pages}) == 1
        assert len(reads) == 2

    asyncio.run(run())
    assert len(reads) == 2
