"""The server process itself, without its socket."""

from __future__ import annotations

import asyncio
import gc

import pytest
import uvicorn
from fastapi import FastAPI

from surrogym_server.cli.runner import Runner
from surrogym_server.settings import read_settings


def test_what_was_imported_is_kept_out_of_collections(monkeypatch: pytest.MonkeyPatch):
    async def nothing(*_: object) -> None: ...

    monkeypatch.setattr(uvicorn.Server, "startup", nothing)
    runner = Runner(FastAPI(), read_settings({}), "http://127.0.0.1:1", None, lambda _: None)
    gc.unfreeze()
    try:
        asyncio.run(runner.startup())
        assert len(gc.get_objects()) < gc.get_freeze_count() / 10, "a full collection stops the loop for some 200 ms"
    finally:
        gc.unfreeze()
