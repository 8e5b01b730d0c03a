"""Claiming with a long poll: it wakes for a query, for the end of the design and for the end of the server."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

import numpy as np
import pytest

from support.queries import steps
from surrogym_server.errors import UnknownSurrogate
from surrogym_server.services.definitions import Definitions
from surrogym_server.services.notices import Notices
from surrogym_server.services.queries import Claim, QueryService
from surrogym_server.storage.sql import Storage

NAME = "pendulum"
PATIENCE = 60.0


async def waiting_claim(service: QueryService, event: Callable[[], object]) -> tuple[Claim, float]:
    """What a waiting claim gets after an event, and how long it took."""
    claim = asyncio.create_task(service.claim(NAME, "tester", 4, 60, PATIENCE))
    await asyncio.sleep(0.2)
    assert not claim.done()
    event()
    start = time.monotonic()
    return await claim, time.monotonic() - start


@pytest.fixture
def emptied(storage: Storage) -> Storage:
    """All queries are leased to another."""
    storage.queries.claim(NAME, "other", 100, 3600)
    return storage


def test_a_sampler_gets_pending_queries_without_waiting(storage: Storage, definitions: Definitions):
    async def run() -> Claim:
        return await QueryService(storage, definitions, Notices()).claim(NAME, "tester", 2, 60, PATIENCE)

    claim = asyncio.run(run())
    assert (len(claim.queries), claim.phase, claim.paused) == (2, "collecting", False)


def test_a_sampler_that_does_not_wait_gets_an_empty_list_if_no_query_is_pending(
    emptied: Storage, definitions: Definitions
):
    async def run() -> Claim:
        return await QueryService(emptied, definitions, Notices()).claim(NAME, "tester", 2, 60, 0)

    assert asyncio.run(run()).queries == []


def test_a_new_query_is_given_to_a_waiting_sampler_at_once(emptied: Storage, definitions: Definitions):
    async def run() -> tuple[Claim, float]:
        service = QueryService(emptied, definitions, Notices())
        return await waiting_claim(service, lambda: service.add(NAME, steps([[0.0, 0.0]], [[0.0]]), None))

    claim, seconds = asyncio.run(run())
    assert [query.purpose for query in claim.queries] == ["manual"]
    assert seconds < PATIENCE / 2


def test_a_waiting_sampler_returns_when_the_design_ends(emptied: Storage, definitions: Definitions):
    async def run() -> tuple[Claim, float]:
        notices = Notices()

        def finish() -> None:
            emptied.surrogates.set_phase(NAME, "ready")
            notices.post(NAME)

        return await waiting_claim(QueryService(emptied, definitions, notices), finish)

    claim, seconds = asyncio.run(run())
    assert (claim.queries, claim.phase) == ([], "ready")
    assert seconds < PATIENCE / 2


def test_a_waiting_sampler_returns_when_the_server_stops(emptied: Storage, definitions: Definitions):
    async def run() -> tuple[Claim, float]:
        notices = Notices()
        return await waiting_claim(QueryService(emptied, definitions, notices), notices.close)

    assert asyncio.run(run())[1] < PATIENCE / 2


def test_two_waiting_samplers_share_new_queries(emptied: Storage, definitions: Definitions):
    async def run() -> list[Claim]:
        service = QueryService(emptied, definitions, Notices())
        claims = [asyncio.create_task(service.claim(NAME, f"tester {i}", 1, 60, PATIENCE)) for i in range(2)]
        await asyncio.sleep(0.2)
        service.add(NAME, steps([[0.0, 0.0], [1.0, 1.0]], np.zeros((2, 1))), None)
        return await asyncio.gather(*claims)

    ids = [query.id for claim in asyncio.run(run()) for query in claim.queries]
    assert len(set(ids)) == len(ids) == 2


def test_a_waiting_sampler_gets_an_error_when_the_surrogate_is_deleted(emptied: Storage, definitions: Definitions):
    async def run() -> None:
        notices = Notices()

        def delete() -> None:
            emptied.surrogates.delete(NAME)
            notices.post(NAME)

        with pytest.raises(UnknownSurrogate):
            await waiting_claim(QueryService(emptied, definitions, notices), delete)

    asyncio.run(run())
