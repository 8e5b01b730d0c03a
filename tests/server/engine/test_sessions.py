"""The live sessions: one request at a time in each, replay while it runs, expiry, and a cap."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest

from surrogym_server.engine.session import Outcome, Session, reset_session
from surrogym_server.engine.sessions import LiveSessions
from surrogym_server.errors import Overloaded, SeqConflict, SessionExpired, UnknownSession

Open = Callable[..., Session]


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def live(clock: Clock) -> Iterator[LiveSessions]:
    with ThreadPoolExecutor(2) as threads:
        yield LiveSessions(threads, limit=2, idle_seconds=10, clock=clock)


def work(session: Session) -> tuple[Session, Outcome]:
    return reset_session(session, None, None, 1)


class Slow:
    """Work that waits to be let go, and counts how often it was begun."""

    def __init__(self) -> None:
        self.begun = 0
        self.go = threading.Event()

    def __call__(self, session: Session) -> tuple[Session, Outcome]:
        self.begun += 1
        assert self.go.wait(30)
        return work(session)


def test_a_repeat_while_the_first_runs_waits_for_its_answer(live: LiveSessions, opened: Open):
    slow = Slow()
    live.add(opened())

    async def twice() -> list[object]:
        both = [asyncio.create_task(live.advance("s", 1, "same", slow)) for _ in range(2)]
        while not slow.begun:
            await asyncio.sleep(0.001)
        slow.go.set()
        return await asyncio.gather(*both)

    first, second = asyncio.run(twice())
    assert first is second
    assert (slow.begun, live.get("s").seq) == (1, 1)


def test_another_session_and_the_loop_go_on_meanwhile(live: LiveSessions, opened: Open):
    slow = Slow()
    live.add(opened("slow"))
    live.add(opened("quick"))

    async def both() -> None:
        waiting = asyncio.create_task(live.advance("slow", 1, "d", slow))
        await live.advance("quick", 1, "d", work)
        assert not waiting.done()
        slow.go.set()
        await waiting

    asyncio.run(both())


def test_work_that_fails_changes_nothing(live: LiveSessions, opened: Open):
    live.add(opened())

    def fail(session: Session) -> tuple[Session, Outcome]:
        raise ValueError("bad action")

    async def run() -> None:
        before = live.get("s")
        with pytest.raises(ValueError, match="bad action"):
            await live.advance("s", 1, "d", fail)
        assert live.get("s") is before
        assert (await live.advance("s", 1, "d", work)).seq == 1
        with pytest.raises(SeqConflict, match="expected seq 2, got 7"):
            await live.advance("s", 7, "d", work)

    asyncio.run(run())


def test_quick_work_is_done_without_a_thread_once_it_is_known(live: LiveSessions, opened: Open):
    live.add(opened())
    threads: list[str] = []

    def note(session: Session) -> tuple[Session, Outcome]:
        threads.append(threading.current_thread().name)
        return session, ()

    async def run() -> None:
        for _ in range(20):
            await live.advance("s", None, "d", note)

    asyncio.run(run())
    assert threads[0] != threading.current_thread().name, "how long it takes is not known yet"
    assert threads[-1] == threading.current_thread().name


def test_an_idle_session_expires_with_an_error_of_its_own(live: LiveSessions, opened: Open, clock: Clock):
    live.add(opened("idle"))
    live.add(opened("used"))
    clock.now = 9
    asyncio.run(live.advance("used", 1, "d", work))
    clock.now = 11
    assert live.sweep() == ["idle"]
    with pytest.raises(SessionExpired, match="idle for more than 10 s"):
        live.get("idle")
    with pytest.raises(UnknownSession):
        live.get("never")
    assert live.get("used").seq == 1


def test_a_session_at_work_is_not_idle(live: LiveSessions, opened: Open, clock: Clock):
    slow = Slow()
    live.add(opened())

    async def run() -> None:
        waiting = asyncio.create_task(live.advance("s", 1, "d", slow))
        while not slow.begun:
            await asyncio.sleep(0.001)
        clock.now = 1_000
        assert live.sweep() == []
        slow.go.set()
        await waiting
        assert live.sweep() == []

    asyncio.run(run())


def test_no_more_than_the_limit_are_open(live: LiveSessions, opened: Open):
    for id in ("a", "b"):
        live.add(opened(id))
    with pytest.raises(Overloaded, match="fewer than 2"):
        live.add(opened("c"))
    live.close("a")
    live.close("a")
    live.add(opened("c"))
    assert {session.id for session in live} == {"b", "c"}
