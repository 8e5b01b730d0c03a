"""The live sessions: one request at a time in each, replay while it runs, expiry, and a cap."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest

from surrogym_server.engine.local import MEBIBYTE, Limits, LiveSessions, Threads
from surrogym_server.engine.session import Fingerprint, Outcome, Session, reset_session
from surrogym_server.errors import (
    DeadlineExceeded,
    Overloaded,
    SeqConflict,
    SessionExpired,
    TooLarge,
    Unavailable,
    UnknownSession,
)

Open = Callable[..., Session]
LIMITS = Limits(sessions=2, nbytes=MEBIBYTE, requests=3)


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def live(clock: Clock) -> Iterator[LiveSessions]:
    with ThreadPoolExecutor(2) as steps, ThreadPoolExecutor(1) as rollouts:
        yield LiveSessions(Threads(steps, 2), Threads(rollouts, 1), limits=LIMITS, idle_seconds=10, clock=clock)


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


def test_a_repeated_request_waits_for_the_reply_of_the_running_one(live: LiveSessions, opened: Open):
    slow = Slow()
    live.add(opened())

    async def twice() -> list[object]:
        both = [asyncio.create_task(live.advance("s", 1, Fingerprint("same"), slow)) for _ in range(2)]
        while not slow.begun:
            await asyncio.sleep(0.001)
        slow.go.set()
        return await asyncio.gather(*both)

    first, second = asyncio.run(twice())
    assert first is second
    assert (slow.begun, live.get("s").seq) == (1, 1)


def test_a_slow_request_does_not_block_another_session(live: LiveSessions, opened: Open):
    slow = Slow()
    live.add(opened("slow"))
    live.add(opened("quick"))

    async def both() -> None:
        waiting = asyncio.create_task(live.advance("slow", 1, Fingerprint("d"), slow))
        await live.advance("quick", 1, Fingerprint("d"), work)
        assert not waiting.done()
        slow.go.set()
        await waiting

    asyncio.run(both())


def test_a_step_does_not_wait_for_the_rollouts_of_other_sessions(opened: Open):
    slow = Slow()
    with ThreadPoolExecutor(1) as steps, ThreadPoolExecutor(1) as rollouts:
        live = LiveSessions(Threads(steps, 1), Threads(rollouts, 1), limits=LIMITS, idle_seconds=10)
        live.add(opened("planner"))
        live.add(opened("trainer"))

        async def both() -> None:
            rollout = asyncio.create_task(live.advance("planner", 1, Fingerprint("d"), slow, steps=2))
            while not slow.begun:
                await asyncio.sleep(0.001)
            try:
                await asyncio.wait_for(live.advance("trainer", 1, Fingerprint("d"), work), 20)
            finally:
                slow.go.set()
            await rollout

        asyncio.run(both())


@pytest.mark.parametrize(("end", "error"), [("close", UnknownSession), ("stop", Unavailable)])
def test_a_running_rollout_ends_when_its_session_or_the_server_closes(opened: Open, end: str, error: type[Exception]):
    begun = threading.Event()
    with ThreadPoolExecutor(1) as steps, ThreadPoolExecutor(1) as rollouts:
        live = LiveSessions(Threads(steps, 1), Threads(rollouts, 1), limits=LIMITS, idle_seconds=10)
        live.add(opened("planner"))

        def endless(session: Session) -> tuple[Session, Outcome]:
            while True:
                begun.set()
                live.check_wanted("planner")

        async def run() -> None:
            rollout = asyncio.create_task(live.advance("planner", 1, Fingerprint("d"), endless, steps=2))
            while not begun.is_set() and not rollout.done():
                await asyncio.sleep(0.001)
            live.close("planner") if end == "close" else live.stop()
            with pytest.raises(error):
                await rollout

        asyncio.run(run())


def test_a_failed_step_leaves_the_session_unchanged(live: LiveSessions, opened: Open):
    live.add(opened())

    def fail(session: Session) -> tuple[Session, Outcome]:
        raise ValueError("bad action")

    async def run() -> None:
        before = live.get("s")
        with pytest.raises(ValueError, match="bad action"):
            await live.advance("s", 1, Fingerprint("d"), fail)
        assert live.get("s") is before
        assert (await live.advance("s", 1, Fingerprint("d"), work)).seq == 1
        with pytest.raises(SeqConflict, match="expected seq 2, got 7"):
            await live.advance("s", 7, Fingerprint("d"), work)

    asyncio.run(run())


def test_steps_measured_as_quick_run_in_the_event_loop_thread(live: LiveSessions, opened: Open):
    live.add(opened())
    threads: list[str] = []

    def note(session: Session) -> tuple[Session, Outcome]:
        threads.append(threading.current_thread().name)
        return session, ()

    async def run() -> None:
        for _ in range(20):
            await live.advance("s", None, Fingerprint("d"), note)

    asyncio.run(run())
    assert threads[0] != threading.current_thread().name, "how long it takes is not known yet"
    assert threads[-1] == threading.current_thread().name


def test_an_idle_session_expires_and_later_requests_get_a_specific_error(
    live: LiveSessions, opened: Open, clock: Clock
):
    live.add(opened("idle"))
    live.add(opened("used"))
    clock.now = 9
    asyncio.run(live.advance("used", 1, Fingerprint("d"), work))
    clock.now = 11
    assert live.sweep() == ["idle"]
    with pytest.raises(SessionExpired, match="idle for more than 10 s"):
        live.get("idle")
    with pytest.raises(UnknownSession):
        live.get("never")
    assert live.get("used").seq == 1


def test_a_session_with_a_running_request_does_not_expire(live: LiveSessions, opened: Open, clock: Clock):
    slow = Slow()
    live.add(opened())

    async def run() -> None:
        waiting = asyncio.create_task(live.advance("s", 1, Fingerprint("d"), slow))
        while not slow.begun:
            await asyncio.sleep(0.001)
        clock.now = 1_000
        assert live.sweep() == []
        slow.go.set()
        await waiting
        assert live.sweep() == []

    asyncio.run(run())


def test_opening_more_sessions_than_the_limit_is_refused(live: LiveSessions, opened: Open):
    for id in ("a", "b"):
        live.add(opened(id))
    with pytest.raises(Overloaded, match="at most 2 open sessions"):
        live.add(opened("c"))
    live.close("a")
    live.close("a")
    live.add(opened("c"))
    assert {session.id for session in live} == {"b", "c"}


def test_sessions_and_rollouts_beyond_the_total_memory_limit_are_refused(live: LiveSessions, opened: Open):
    particles = {"variant": "probabilistic", "particles": 10_000}  # 4 lanes of 2 coordinates: 0.6 MiB
    live.add(opened("a", **particles))
    with pytest.raises(Overloaded, match=r"at most 1\.0 MiB of memory, got 0\.6 MiB and 0\.6 MiB more"):
        live.add(opened("b", **particles))
    with pytest.raises(TooLarge, match=r"at most 1\.0 MiB .* got 1\.1 MiB"):
        live.add(opened("c"), reserved=int(1.1 * MEBIBYTE))
    live.add(opened("small"))
    with pytest.raises(Overloaded, match="all sessions to take at most"):
        asyncio.run(live.advance("small", 1, Fingerprint("d"), work, steps=200))
    with pytest.raises(TooLarge, match="fewer steps"):
        asyncio.run(live.advance("small", 1, Fingerprint("d"), work, steps=10_000))
    asyncio.run(live.advance("small", 1, Fingerprint("d"), work, steps=10))
    assert {session.id for session in live} == {"a", "small"}


def test_requests_beyond_the_queue_limit_are_refused(live: LiveSessions, opened: Open):
    slow = Slow()
    live.add(opened())

    async def run() -> None:
        queue = [asyncio.create_task(live.advance("s", 1, Fingerprint("d"), slow)) for _ in range(LIMITS.requests)]
        await asyncio.sleep(0.01)
        with pytest.raises(Overloaded, match="at most 3 requests"):
            await live.advance("s", 1, Fingerprint("d"), slow)
        slow.go.set()
        await asyncio.gather(*queue)
        await live.advance("s", 2, Fingerprint("d"), work)

    asyncio.run(run())


def test_a_request_that_cannot_meet_its_deadline_is_refused_before_it_starts(
    live: LiveSessions, opened: Open, clock: Clock
):
    slow = Slow()
    live.add(opened("known"))
    live.add(opened("waiting"))
    begun = []

    def lasting(session: Session) -> tuple[Session, Outcome]:
        begun.append(session.id)
        time.sleep(0.05)
        return session, ()

    async def run() -> None:
        await live.advance("known", None, Fingerprint("d"), lasting)
        with pytest.raises(DeadlineExceeded, match=r"would take [5-9]\d* ms, and 20 ms are left"):
            await live.advance("known", None, Fingerprint("d"), lasting, deadline=clock.now + 0.02)
        await live.advance("known", None, Fingerprint("d"), lasting, deadline=clock.now + 60)
        before = asyncio.create_task(live.advance("waiting", 1, Fingerprint("d"), slow))
        late = asyncio.create_task(live.advance("waiting", 2, Fingerprint("e"), lasting, deadline=clock.now + 1))
        while not slow.begun:
            await asyncio.sleep(0.001)
        clock.now += 2
        slow.go.set()
        with pytest.raises(DeadlineExceeded, match="and 0 ms are left"):
            await late
        assert (await before).seq == 1, "a kept answer has no deadline"
        assert (await live.advance("waiting", 1, Fingerprint("d"), slow, deadline=clock.now)).seq == 1

    asyncio.run(run())
    assert begun == ["known", "known"]
