"""Lines of claims: the first ask the database for all, work goes to one claim each, and nobody waits for nothing."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

import pytest

from surrogym_server.services.claim_queues import FIRST, ClaimQueues
from surrogym_server.services.notices import Notices

PATIENCE, MANY = 60.0, 300


class Shop:
    """Work to claim, and the number of questions for it."""

    def __init__(self) -> None:
        self.work: list[int] = []
        self.asked = 0

    def ask(self) -> int | str:
        self.asked += 1
        return self.work.pop() if self.work else "none"


def run(test: Callable[[Shop, Notices, Callable[..., Awaitable[int | str]]], Awaitable[None]]) -> None:
    async def prepared() -> None:
        shop, notices = Shop(), Notices()
        queues = ClaimQueues[int | str](notices, lambda answer: isinstance(answer, int))

        def claim(seconds: float = PATIENCE) -> Awaitable[int | str]:
            return asyncio.create_task(queues.claim("a", None, shop.ask, seconds))

        await asyncio.wait_for(test(shop, notices, claim), PATIENCE / 2)

    asyncio.run(prepared())


@pytest.mark.parametrize("waiting", [10, MANY])
def test_the_number_of_database_reads_does_not_grow_with_waiting_samplers(waiting: int):
    async def scenario(shop: Shop, notices: Notices, claim: Callable[..., Awaitable[int | str]]) -> None:
        claims = [claim() for _ in range(waiting)]
        await asyncio.sleep(0.2)
        assert shop.asked <= FIRST
        notices.post("a")
        await asyncio.sleep(0.2)
        assert shop.asked <= 2 * FIRST
        notices.close()
        assert set(await asyncio.gather(*claims)) == {"none"}
        assert shop.asked <= 3 * FIRST

    run(scenario)


def test_all_new_queries_are_handed_to_the_waiting_samplers():
    async def scenario(shop: Shop, notices: Notices, claim: Callable[..., Awaitable[int | str]]) -> None:
        claims = [claim() for _ in range(MANY)]
        await asyncio.sleep(0.1)
        shop.work = list(range(MANY))
        notices.post("a")
        assert sorted(await asyncio.gather(*claims), key=int) == [*range(MANY)]

    run(scenario)


def test_a_sampler_that_does_not_wait_gets_new_queries_despite_waiting_samplers():
    async def scenario(shop: Shop, notices: Notices, claim: Callable[..., Awaitable[int | str]]) -> None:
        claims = [claim(1.0) for _ in range(FIRST)]
        await asyncio.sleep(0.1)
        assert await claim(0.0) == "none"
        asked, shop.work = shop.asked, [7, 8, 9, 10, 11]
        notices.post("a")
        assert {await claim(0.0), *(await asyncio.gather(*claims))} == {7, 8, 9, 10, 11}
        assert shop.asked == asked + 5

    run(scenario)


def test_a_waiting_sampler_that_disconnected_is_given_no_query():
    async def scenario(shop: Shop, notices: Notices, _: object) -> None:
        async def present() -> None:
            raise ConnectionError

        queues = ClaimQueues[int | str](notices, lambda answer: isinstance(answer, int))
        shop.work = [1]
        with pytest.raises(ConnectionError):
            await queues.claim("a", None, shop.ask, PATIENCE, present)
        assert shop.work == [1]

    run(scenario)
