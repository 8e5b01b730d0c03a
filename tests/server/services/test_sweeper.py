"""The sweeper goes on, whatever one sweep meets."""

from __future__ import annotations

import asyncio

import pytest

from surrogym_server.engine.local import Limits, LocalEngine
from surrogym_server.engine.models import ModelCache
from surrogym_server.errors import Unavailable
from surrogym_server.services.metrics import ProcessMetrics
from surrogym_server.services.notices import Notices
from surrogym_server.services.sweeper import Sweeper
from surrogym_server.storage.sql import Storage

NAME = "pendulum"


def test_a_failed_sweep_of_expired_leases_is_followed_by_the_next(storage: Storage, monkeypatch: pytest.MonkeyPatch):
    met = [Unavailable("the disk is full"), ZeroDivisionError("surprise"), None]

    def sweep_expired() -> int:
        if (error := met.pop(0)) is not None:
            raise error
        return 3

    async def run() -> int:
        metrics = ProcessMetrics()
        models = ModelCache(lambda *_: pytest.fail("nothing is in use"), storage.models.newest)
        engine = LocalEngine(models, lambda *_: (), limits=Limits(), max_lanes=1, idle_seconds=60.0)
        sweeper = asyncio.create_task(Sweeper(storage, engine, 0.001, metrics, Notices()).run())
        while met:
            await asyncio.sleep(0.001)
        while not metrics.expired_leases and not sweeper.done():
            await asyncio.sleep(0.001)
        sweeper.cancel()
        await engine.stop()
        return metrics.expired_leases

    monkeypatch.setattr(storage.queries, "sweep_expired", sweep_expired)
    assert asyncio.run(asyncio.wait_for(run(), 10)) == 3


def test_the_periodic_sweep_wakes_listeners_of_a_change_whose_notice_was_lost(storage: Storage):
    async def run() -> None:
        notices = Notices()
        models = ModelCache(lambda *_: pytest.fail("nothing is in use"), storage.models.newest)
        engine = LocalEngine(models, lambda *_: (), limits=Limits(), max_lanes=1, idle_seconds=60.0)
        sweeper = Sweeper(storage, engine, 3_600.0, ProcessMetrics(), notices)
        with notices.listen(NAME) as listener:
            await sweeper.sweep()  # it also wakes those that it sees for the first time
            assert await listener.wait(60.0)
            await sweeper.sweep()
            assert not await listener.wait(0.05)
            storage.ledger.report(NAME, 5, key="k")
            await sweeper.sweep()
            assert await listener.wait(60.0)
        await engine.stop()

    asyncio.run(run())
