"""The sweeper goes on, whatever one sweep meets."""

from __future__ import annotations

import asyncio

import pytest

from surrogym_server.engine.local import LocalEngine
from surrogym_server.engine.models import ModelCache
from surrogym_server.engine.sessions import Limits
from surrogym_server.errors import Unavailable
from surrogym_server.services.metrics import ProcessMetrics
from surrogym_server.services.sweeper import Sweeper
from surrogym_server.storage.port import Storage


def test_a_sweep_that_fails_is_followed_by_the_next(storage: Storage, monkeypatch: pytest.MonkeyPatch):
    met = [Unavailable("the disk is full"), ZeroDivisionError("surprise"), None]

    def sweep_expired() -> int:
        if (error := met.pop(0)) is not None:
            raise error
        return 3

    async def run() -> int:
        metrics = ProcessMetrics()
        models = ModelCache(lambda *_: pytest.fail("nothing is in use"), storage.models.newest)
        engine = LocalEngine(models, lambda *_: (), limits=Limits(), max_lanes=1, idle_seconds=60.0)
        sweeper = asyncio.create_task(Sweeper(storage, engine, 0.001, metrics).run())
        while met:
            await asyncio.sleep(0.001)
        while not metrics.expired_leases and not sweeper.done():
            await asyncio.sleep(0.001)
        sweeper.cancel()
        await engine.stop()
        return metrics.expired_leases

    monkeypatch.setattr(storage.queries, "sweep_expired", sweep_expired)
    assert asyncio.run(asyncio.wait_for(run(), 10)) == 3
