"""The server process itself, without its socket."""

from __future__ import annotations

import asyncio
import gc
from collections.abc import Iterator

import pytest
import uvicorn
from fastapi import FastAPI

from surrogym_server.cli.runner import Runner
from surrogym_server.settings import read_settings


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A runner whose server has started."""

    async def nothing(*_: object) -> None: ...

    monkeypatch.setattr(uvicorn.Server, "startup", nothing)
    runner, thresholds = (
        Runner(FastAPI(), read_settings({}), "http://127.0.0.1:1", None, lambda _: None),
        gc.get_threshold(),
    )
    gc.unfreeze()
    asyncio.run(runner.startup())
    yield
    gc.set_threshold(*thresholds)


@pytest.mark.usefixtures("started")
def test_imported_objects_are_frozen_out_of_garbage_collection():
    assert len(gc.get_objects()) < gc.get_freeze_count() / 10, "a full collection stops the loop for some 200 ms"


@pytest.mark.usefixtures("started")
def test_reading_a_page_of_samples_triggers_no_garbage_collection():
    """Its records live until the reply is written, so no collection would find any of them."""
    collections = [generation["collections"] for generation in gc.get_stats()]
    records = [{"coordinates": [0.0, 0.0], "action": [0.0], "next_coordinates": [0.0, 0.0]} for _ in range(1_000)]
    assert [generation["collections"] for generation in gc.get_stats()] == collections
    assert len(records) == 1_000
