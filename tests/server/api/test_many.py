"""What shows all surrogates asks the database as often for many as for a few."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest
import sqlalchemy as sa
from fastapi import FastAPI

from support.many import fill
from surrogym_server.app import create_app
from surrogym_server.settings import Settings

NEVER = 3_600.0  # seconds between looks of sweeper and designer, whose statements are not those of a request


def statements(folder: Path, count: int, path: str) -> int:
    """How many statements one request takes on a server of so many surrogates."""
    sent: list[str] = []

    def note(_: object, __: object, statement: str, *___: object) -> None:
        if "AnyIO" in threading.current_thread().name:  # the threads that requests are worked on in
            sent.append(statement)

    database = folder / f"{count}.db"
    fill(database, count)
    settings = Settings(database=str(database), host="testserver", insecure=True, sweep_seconds=NEVER)
    sa.event.listen(sa.Engine, "before_cursor_execute", note)
    try:
        text = asyncio.run(answered(create_app(settings), path, sent.clear))
    finally:
        sa.event.remove(sa.Engine, "before_cursor_execute", note)
    assert text.count("finished") >= count / 2
    return len(sent)


async def answered(app: FastAPI, path: str, first_ended: Callable[[], None]) -> str:
    """The body of the second of two requests to an app in this process. The first counts samples and queries, unless
    the server has counted them already."""
    async with app.router.lifespan_context(app) as state:

        async def served(scope: Any, receive: Any, send: Any) -> None:
            await app({**scope, "state": dict(state or {})}, receive, send)

        async with httpx.AsyncClient(transport=httpx.ASGITransport(served), base_url="http://testserver") as client:
            (await client.get(path)).raise_for_status()
            first_ended()
            return (await client.get(path)).raise_for_status().text


@pytest.mark.parametrize("path", ["/metrics", "/v1/surrogates"])
def test_listing_many_surrogates_takes_as_many_sql_statements_as_a_few(tmp_path: Path, path: str):
    few, many = (statements(tmp_path, count, path) for count in (4, 60))
    assert 0 < few == many < 10
