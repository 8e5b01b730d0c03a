"""Notices: none is lost between a look and a wait, and a cancelled wait ends."""

from __future__ import annotations

import asyncio

import pytest

from surrogym_server.services.notices import Notices
from surrogym_server.storage.sql.events import Announcements, Hear

PATIENCE = 60.0


def test_a_notice_posted_before_the_wait_still_wakes_the_listener():
    async def run() -> None:
        notices = Notices()
        with notices.listen("a") as listener:
            await asyncio.to_thread(notices.post, "a")
            await asyncio.wait_for(listener.wait(3600), PATIENCE)

    asyncio.run(run())


def test_a_notice_wakes_only_listeners_of_its_surrogate():
    async def run() -> list[bool]:
        notices = Notices()
        with notices.listen("a") as a, notices.listen("b") as b, notices.listen() as everything:
            tasks = [asyncio.create_task(listener.wait(3600)) for listener in (a, b, everything)]
            notices.post("a")
            await asyncio.sleep(0.05)
            done = [task.done() for task in tasks]
            tasks[1].cancel()
            return done

    assert asyncio.run(run()) == [True, False, True]


def test_a_wait_for_a_notice_ends_at_its_timeout():
    async def run() -> None:
        with Notices().listen("a") as listener:
            await listener.wait(0.01)
            await listener.wait(-1)

    asyncio.run(run())


def test_a_listener_woken_and_cancelled_at_the_same_time_raises_cancelled():
    async def run() -> None:
        notices = Notices()
        with notices.listen("a") as listener:
            task = asyncio.create_task(listener.wait(3600))
            await asyncio.sleep(0)
            notices.close()
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task

    asyncio.run(run())


def test_a_notice_posted_after_the_event_loop_ended_is_harmless():
    async def make() -> Notices:
        return Notices()

    asyncio.run(make()).post("a")


class Told(Announcements):
    """Notes what is announced, and lets a test speak for the other servers."""

    def __init__(self) -> None:
        self.announced: list[str] = []
        self.hear: Hear | None = None

    def announce(self, surrogate: str) -> None:
        self.announced.append(surrogate)

    def listen(self, hear: Hear) -> None:
        self.hear = hear

    def close(self) -> None:
        pass


def test_an_announcement_of_another_server_wakes_listeners_and_is_not_repeated():
    async def run() -> None:
        told = Told()
        notices = Notices(told)
        assert told.hear is not None
        with notices.listen("a") as a, notices.listen("b") as b:
            await asyncio.to_thread(told.hear, "a")
            assert [await listener.wait(0.05) for listener in (a, b)] == [True, False]
            await asyncio.to_thread(told.hear, None)
            assert [await listener.wait(PATIENCE) for listener in (a, b)] == [True, True]
        notices.post("b")
        assert told.announced == ["b"]

    asyncio.run(run())
