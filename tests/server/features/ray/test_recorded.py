"""Sessions under leases, with checkpoints: two hosts in this process, on one SQLite file."""

from __future__ import annotations

import asyncio
import pickle
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from support.engine_laws import LAWS_OF_ENGINES, EngineCase
from surrogym_sampler.original import classic
from surrogym_server.convert import stored_definition
from surrogym_server.engine.local import Limits
from surrogym_server.engine.requests import Advance, Reply
from surrogym_server.errors import Overloaded, SeqConflict, Unavailable, UnknownSession
from surrogym_server.features.ray import leases
from surrogym_server.features.ray.host import HostSettings, recorded_engine
from surrogym_server.features.ray.leases import Pace
from surrogym_server.features.ray.recorded import RecordedEngine
from surrogym_server.features.ray.store import LiveSessions, SessionLease
from surrogym_server.storage.sql import Storage, open_storage

NAME, LEASE = "pendulum", 60.0


@dataclass
class Clock:
    seconds: float = 1_000.0

    def __call__(self) -> float:
        return self.seconds


@dataclass
class Host:
    engine: RecordedEngine
    clock: Clock
    case: EngineCase

    async def replies(self, requests: list[Advance]) -> list[Reply]:
        return [await self.engine.advance(request) for request in requests]

    async def record(self) -> None:
        self.clock.seconds += 1
        await self.leases.record(self.engine._inner.sessions())

    @property
    def leases(self) -> leases.Leases:
        return self.engine._leases


@pytest.fixture
def storage(tmp_path: Path) -> Iterator[Storage]:
    opened = open_storage(f"sqlite:///{tmp_path}/surrogym.db")
    yield opened
    opened.close()


@pytest.fixture
def host(storage: Storage, fill: Callable[[Storage], int]) -> Callable[..., Host]:
    """A host of the pool; its loops don't run, so nothing is renewed and recorded unless a test says so."""
    surrogate, numbers = fill(storage), iter(range(10))

    def start(machine: str = "this kind", **limits: Any) -> Host:
        pace = Pace(0.0, LEASE)
        settings = HostSettings(2, "", Limits(**limits), 64, 60.0, "cpu", 1, pace)
        clock = Clock()
        engine = recorded_engine(settings, storage, next(numbers), machine, clock)
        return Host(engine, clock, EngineCase(engine, NAME, surrogate, stored_definition(classic.pendulum())))

    return start


@pytest.fixture
def end_lease(storage: Storage) -> Callable[[Host, str], None]:
    """End the lease of a session by the database's clock, as if its host had been gone for so long."""

    def end(host: Host, session: str) -> None:
        storage.part(LiveSessions).release(host.leases._held[session].lease)

    return end


@pytest.mark.parametrize("law", LAWS_OF_ENGINES, ids=lambda law: law.__name__)
def test_a_ray_session_host_passes_the_engine_interface_tests(law, host):
    async def kept() -> None:
        one = host()
        await one.engine.start()
        try:
            await law(one.case)
        finally:
            await one.engine.stop()

    asyncio.run(kept())


def test_a_session_resumed_from_its_checkpoint_gives_bit_equal_replies(host, end_lease):
    """The requests since the checkpoint are refused with the seq to begin from, and sent again they get the same."""

    async def moved() -> None:
        first, second = host(), host()
        session = await first.case.opened(occupancy=True)
        requests = first.case.steps(session)
        before = await first.replies(requests[:3])
        await first.record()
        before += await first.replies(requests[3:6])
        end_lease(first, session)
        info = await second.engine.take(session)
        assert (info.seq, info.behind) == (4, True)
        with pytest.raises(SeqConflict) as refused:
            await second.engine.advance(requests[6])
        assert refused.value.expected == 5
        again = await second.replies(requests[3:6])
        assert (await second.engine.describe(session)).behind is False
        after = await second.replies(requests[6:])
        twin = await second.case.opened(occupancy=True)
        undisturbed = await second.replies(second.case.steps(twin))
        require_same(again, before[3:])
        require_same(before + after, undisturbed)
        assert (await second.engine.coordinates(session) == await second.engine.coordinates(twin)).all()
        visited = [(await second.engine.submit(id)).states for id in (session, twin)]
        assert visited[0].tolist() == visited[1].tolist()

    asyncio.run(moved())


def test_the_next_session_host_can_repeat_the_last_reply(host, end_lease):
    async def moved() -> None:
        first, second = host(), host()
        session = await first.case.opened()
        requests = first.case.steps(session, 2)
        replies = await first.replies(requests)
        await first.record()
        end_lease(first, session)
        await second.engine.take(session)
        require_same(await second.replies(requests[1:]), replies[1:])
        assert (await second.engine.describe(session)).behind is False, "the client lacks nothing"

    asyncio.run(moved())


def test_a_session_host_with_an_expired_lease_refuses_every_step(host, end_lease):
    """As one that was stopped and wakes: it asks no database, and what it did is replaced by what the next host did."""

    async def woken() -> None:
        first, second = host(), host()
        session = await first.case.opened()
        requests = first.case.steps(session)
        await first.replies(requests[:2])
        first.clock.seconds += LEASE
        for asked in (first.engine.advance(requests[2]), first.engine.describe(session), first.engine.submit(session)):
            with pytest.raises(Unavailable, match=r"the lease of session .* has ended"):
                await asked
        end_lease(first, session)
        await second.engine.take(session)
        await first.record()
        with pytest.raises(Unavailable):
            await first.engine.advance(requests[2])
        await first.leases.renew()
        with pytest.raises(UnknownSession):
            await first.engine.advance(requests[2])
        assert (await second.engine.describe(session)).seq == 0, "the late checkpoint changed nothing"

    asyncio.run(woken())


def test_a_session_host_can_renew_an_expired_lease_nobody_else_took(host):
    """As while the database was away for longer than a lease."""

    async def renewed() -> None:
        one = host()
        session, twin = await one.case.opened(), await one.case.opened()
        one.clock.seconds += 2 * LEASE
        await refused(Unavailable, one.engine.advance(one.case.steps(session)[0]))
        await one.leases.renew()
        require_same(await one.replies(one.case.steps(session)), await one.replies(one.case.steps(twin)))

    asyncio.run(renewed())


@pytest.mark.parametrize("taken", [True, False])
def test_a_step_during_which_the_session_lease_expired_is_not_answered(host, end_lease, monkeypatch, taken: bool):
    async def stopped() -> None:
        first, second = host(), host()
        session = await first.case.opened()
        request, inner = first.case.steps(session)[0], first.engine._inner
        carried_out = inner.advance

        async def stop_and_wake(request: Advance) -> Reply:
            reply = await carried_out(request)
            first.clock.seconds += LEASE
            if taken:
                end_lease(first, session)
                await second.engine.take(session)
                await first.leases.renew()
            return reply

        monkeypatch.setattr(inner, "advance", stop_and_wake)
        await refused(UnknownSession if taken else Unavailable, first.engine.advance(request))
        monkeypatch.setattr(inner, "advance", carried_out)
        if not taken:
            await first.leases.renew()
            assert (await first.engine.advance(request)).seq == 2, "the repeat gets the reply"

    asyncio.run(stopped())


@pytest.mark.parametrize("what", ["without a seq", "coordinates", "submit"])
def test_a_session_resumed_from_an_old_checkpoint_answers_only_repeated_requests(
    host, end_lease, storage: Storage, what: str
):
    async def asked() -> None:
        first, second = host(), host()
        session = await first.case.opened(occupancy=True)
        end_lease(first, session)
        await second.engine.take(session)
        calls: dict[str, Callable[[], Awaitable[object]]] = {
            "without a seq": lambda: second.engine.advance(replace(first.case.steps(session)[0], seq=None)),
            "coordinates": lambda: second.engine.coordinates(session),
            "submit": lambda: second.engine.submit(session),
        }
        await refused(UnknownSession, calls[what](), "was lost with its session host")
        await refused(UnknownSession, second.engine.advance(first.case.steps(session)[0]))
        assert storage.part(LiveSessions).holder(session) is None

    asyncio.run(asked())


def test_a_session_cannot_move_to_another_kind_of_machine_and_says_why(host, end_lease, storage: Storage):
    async def moved() -> None:
        first, second = host(), host(machine="another kind")
        session = await first.case.opened()
        end_lease(first, session)
        await refused(UnknownSession, second.engine.take(session), "no host of the same kind of machine")
        assert storage.part(LiveSessions).holder(session) is None

    asyncio.run(moved())


def test_a_session_too_large_for_a_checkpoint_cannot_move_and_says_why(host, end_lease, monkeypatch):
    async def moved() -> None:
        first, second = host(), host()
        session = await first.case.opened()
        monkeypatch.setattr(leases, "MAX_BYTES", 100)
        await first.record()
        end_lease(first, session)
        await refused(UnknownSession, second.engine.take(session), "too large to be recorded")

    asyncio.run(moved())


def test_a_full_session_host_leaves_a_free_session_to_another_host(host, end_lease):
    async def moved() -> None:
        first, full, third = host(), host(sessions=1), host()
        session = await first.case.opened()
        await full.case.opened()
        await first.record()
        end_lease(first, session)
        await refused(Overloaded, full.engine.take(session))
        assert (await third.engine.take(session)).seq == 1

    asyncio.run(moved())


def test_a_session_with_a_valid_lease_cannot_be_taken_by_another_host(host):
    async def moved() -> None:
        first, second = host(), host()
        session = await first.case.opened()
        await refused(Unavailable, second.engine.take(session), "belongs to another session host")
        assert (await first.engine.take(session)).behind is False, "its own host has it"

    asyncio.run(moved())


def test_the_stored_record_of_a_session_is_deleted_when_it_ends(host, storage: Storage):
    async def ended() -> None:
        one = host()
        sessions = [await one.case.opened() for _ in range(3)]
        await one.engine.close(sessions[0])
        assert [storage.part(LiveSessions).holder(id) is None for id in sessions] == [True, False, False]
        one.engine._inner.end(sessions[1])  # as a session that was idle for too long
        await one.engine.sweep()
        assert [storage.part(LiveSessions).holder(id) is None for id in sessions] == [True, True, False]
        storage.part(LiveSessions).remove(sessions[2])  # as a front server that closes it
        await one.leases.renew()
        await refused(UnknownSession, one.engine.describe(sessions[2]))

    asyncio.run(ended())


def test_opening_with_one_idempotency_key_at_two_hosts_opens_one_session(host, storage: Storage):
    async def opened() -> None:
        first, second = host(), host()
        info = await first.engine.open(first.case.asked(key="once"))
        await refused(Unavailable, second.engine.open(second.case.asked(key="once")), "with this idempotency key")
        known = storage.part(LiveSessions).opened(first.case.surrogate_id, "once")
        assert known is not None
        assert known[0] == info.id
        assert second.engine._inner.sessions() == []

    asyncio.run(opened())


def test_a_session_whose_storing_was_not_confirmed_is_free_after_its_lease(host, storage: Storage, monkeypatch):
    """The database has it under the host's name, and the host lost the answer, with the connection."""

    async def opened() -> None:
        first, second = host(), host()
        await first.case.opened()
        add = LiveSessions.add
        monkeypatch.setattr(LiveSessions, "add", unconfirmed(add))
        await refused(Unavailable, first.engine.open(first.case.asked(key="once")))
        monkeypatch.setattr(LiveSessions, "add", add)
        known = storage.part(LiveSessions).opened(first.case.surrogate_id, "once")
        assert known is not None
        holder = storage.part(LiveSessions).holder(known[0])
        assert holder is not None
        storage.part(LiveSessions).release(SessionLease(known[0], holder.owner, 1))
        await first.leases.renew()
        assert (await second.engine.take(known[0])).seq == 0

    asyncio.run(opened())


def test_a_session_record_whose_deletion_failed_is_deleted_later(host, storage: Storage, monkeypatch):
    """The session ended while the database was away. Its record would keep the key of its opening."""

    async def ended() -> None:
        one = host()
        session = await one.case.opened()
        remove = LiveSessions.remove
        monkeypatch.setattr(LiveSessions, "remove", away)
        one.engine._inner.end(session)  # as a session that was idle for too long
        await refused(Unavailable, one.engine.sweep())
        monkeypatch.setattr(LiveSessions, "remove", remove)
        await one.engine.sweep()
        assert storage.part(LiveSessions).holder(session) is None

    asyncio.run(ended())


def unconfirmed(add: Callable[..., SessionLease]) -> Callable[..., SessionLease]:
    def committed(*arguments: Any) -> SessionLease:
        add(*arguments)
        return away()

    return committed


def away(*_: object) -> Any:
    raise Unavailable("the database can't be used now: the connection was lost")


async def refused(kind: type[Exception], asked: Awaitable[object], match: str | None = None) -> None:
    with pytest.raises(kind, match=match):
        await asked


def require_same(replies: list[Reply], expected: list[Reply]) -> None:
    assert len(replies) == len(expected)
    for reply, other in zip(replies, expected, strict=True):
        assert pickle.dumps(reply) == pickle.dumps(other) or same(reply, other)


def same(reply: Reply, other: Reply) -> bool:
    assert isinstance(reply.outcome, tuple)
    assert isinstance(other.outcome, tuple)
    fields = [(vars(a), vars(b)) for a, b in zip(reply.outcome, other.outcome, strict=True)]
    return all(np.array_equal(a[name], b[name]) for a, b in fields for name in a)
