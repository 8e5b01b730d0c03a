"""Sessions of a cluster: one owner at a time, a lease that ends by the database's clock, a checkpoint."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

import pytest
import sqlalchemy as sa

from surrogym_server.errors import IdempotencyConflict, Unavailable, UnknownSession, UnknownSurrogate
from surrogym_server.features.ray.store import (
    Checkpoint,
    LiveSessions,
    NewLiveSession,
    SessionLease,
    TakenSession,
    live,
)
from surrogym_server.storage.sql import Storage, database, open_storage

LONG, SHORT, DAY = 60.0, 0.05, 86_400.0
Until = Callable[[Callable[[], bool]], None]


@pytest.fixture
def storage(url: str) -> Iterator[Storage]:
    opened = open_storage(url)
    yield opened
    opened.close()


@pytest.fixture
def surrogate(storage: Storage, make: Callable[..., str]) -> int:
    return storage.surrogates.get(make()).id


@pytest.fixture
def add(storage: Storage, surrogate: int) -> Callable[..., SessionLease]:
    def record(id: str = "s", owner: str = "a", seconds: float = LONG, key: str | None = None) -> SessionLease:
        digest = None if key is None else f"opening under {key}"
        new = NewLiveSession(id, surrogate, "this machine", Checkpoint(0, b"opened"), key, digest)
        return storage.part(LiveSessions).add(new, owner, seconds)

    return record


def test_taking_over_a_session_returns_its_last_checkpoint(storage: Storage, surrogate: int, add, until: Until) -> None:
    lease = add(seconds=SHORT)
    assert storage.part(LiveSessions).record(lease, Checkpoint(7, b"\0seven"))
    until(lambda: seconds_left(storage, "s") < 0)
    taken = storage.part(LiveSessions).take("s", "b", LONG)
    assert taken == TakenSession(SessionLease("s", "b", 2), surrogate, "this machine", Checkpoint(7, b"\0seven"))
    assert storage.part(LiveSessions).record(taken.lease, Checkpoint(9, None))
    assert storage.part(LiveSessions).take("s", "b", LONG).checkpoint == Checkpoint(9, None)


def test_taking_a_session_with_a_valid_lease_is_refused(storage: Storage, add) -> None:
    add()
    with pytest.raises(Unavailable, match=r"belongs to another session host for (59|60)\.\d s more"):
        storage.part(LiveSessions).take("s", "b", LONG)
    holder = storage.part(LiveSessions).holder("s")
    assert holder is not None
    assert (holder.owner, holder.machine) == ("a", "this machine")


def test_an_owner_whose_session_lease_was_replaced_cannot_write(storage: Storage, add, until: Until) -> None:
    old = add(seconds=SHORT)
    until(lambda: seconds_left(storage, "s") < 0)
    new = storage.part(LiveSessions).take("s", "b", LONG).lease
    assert storage.part(LiveSessions).renew("a", ["s"], LONG) == frozenset()
    assert not storage.part(LiveSessions).record(old, Checkpoint(99, b"late"))
    storage.part(LiveSessions).release(old)
    assert seconds_left(storage, "s") > 0
    assert storage.part(LiveSessions).take("s", "b", LONG).checkpoint == Checkpoint(0, b"opened")
    assert not storage.part(LiveSessions).record(new, Checkpoint(1, b"of the lease before"))


def test_an_expired_session_lease_that_nobody_took_can_be_renewed(storage: Storage, add, until: Until) -> None:
    add("s", seconds=SHORT)
    add("t", seconds=SHORT)
    add("u", owner="b")
    until(lambda: seconds_left(storage, "s") < 0 and seconds_left(storage, "t") < 0)
    assert storage.part(LiveSessions).renew("a", ["s", "t", "u", "never"], LONG) == {"s", "t"}
    with pytest.raises(Unavailable):
        storage.part(LiveSessions).take("s", "b", LONG)


def test_a_session_lease_missing_from_its_owners_renewal_expires(storage: Storage, add) -> None:
    """The answer to ``add`` was lost with the connection: the owner never heard of its session."""
    add("s", seconds=SHORT)
    ids = [f"id'{number}" for number in range(70_000)]  # more than a statement may have parameters
    assert storage.part(LiveSessions).renew("a", ids, LONG) == frozenset()
    assert seconds_left(storage, "s") <= SHORT


@pytest.mark.parametrize("url", [pytest.param("postgresql", marks=pytest.mark.postgresql)], indirect=True)
def test_an_owner_stopped_within_a_transaction_locks_its_session_only_briefly(
    url: str, storage: Storage, add, until: Until, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stopped process, or a paused machine, does not end its transaction. Nobody else could ever take the session."""
    monkeypatch.setattr(database, "STALLED_SECONDS", 1)
    lease, stopped = add(seconds=SHORT), database.connect(url)
    until(lambda: seconds_left(storage, "s") < 0)

    def is_taken() -> bool:
        with suppress(Unavailable):
            return storage.part(LiveSessions).take("s", "b", LONG).lease.owner == "b"
        return False

    def write_late() -> None:
        with stopped.write() as connection:
            connection.execute(sa.update(live).where(live.c.id == lease.id).values(seq=5))
            until(is_taken)
            connection.execute(sa.select(live.c.id))

    with pytest.raises(Unavailable, match="the database can't be used now"):
        write_late()
    stopped.close()
    assert storage.part(LiveSessions).take("s", "b", LONG).checkpoint == Checkpoint(0, b"opened")


def test_a_released_session_can_be_taken_at_once(storage: Storage, add) -> None:
    storage.part(LiveSessions).release(add())
    assert storage.part(LiveSessions).take("s", "b", LONG).lease.fence == 2


def test_if_several_hosts_take_a_session_at_once_one_succeeds(storage: Storage, add) -> None:
    storage.part(LiveSessions).release(add())

    def take(owner: str) -> str | None:
        try:
            return storage.part(LiveSessions).take("s", owner, LONG).lease.owner
        except Unavailable:
            return None

    with ThreadPoolExecutor(4) as threads:
        won = [owner for owner in threads.map(take, ("b", "c", "d", "e")) if owner]
    holder = storage.part(LiveSessions).holder("s")
    assert holder is not None
    assert won == [holder.owner]


def test_a_session_is_found_by_the_idempotency_key_of_its_opening(storage: Storage, surrogate: int, add) -> None:
    add("s", key="once")
    add("t")
    add("u")
    assert storage.part(LiveSessions).opened(surrogate, "once") == ("s", "opening under once")
    assert storage.part(LiveSessions).opened(surrogate, "never") is None
    for again in ({"id": "other", "key": "once"}, {"id": "s"}):
        with pytest.raises(IdempotencyConflict):
            add(**again)
    assert storage.part(LiveSessions).holder("other") is None


def test_a_session_record_is_no_longer_found_after_its_removal(storage: Storage, surrogate: int, add) -> None:
    lease = add("s", key="once")
    add("t")
    storage.part(LiveSessions).remove("s")
    storage.part(LiveSessions).remove("s")
    assert storage.part(LiveSessions).holder("s") is None
    assert not storage.part(LiveSessions).record(lease, Checkpoint(1, b""))
    with pytest.raises(UnknownSession):
        storage.part(LiveSessions).take("s", "a", LONG)
    assert add("s", key="once").fence == 1, "its id and key are free again"
    storage.part(LiveSessions).remove_all_of(surrogate + 1)
    storage.part(LiveSessions).remove_all_of(surrogate)
    assert storage.part(LiveSessions).renew("a", ["s", "t"], LONG) == frozenset()


def test_deleting_a_surrogate_deletes_its_session_records(storage: Storage, make, add) -> None:
    add()
    storage.surrogates.delete(make())
    assert storage.part(LiveSessions).holder("s") is None
    with pytest.raises(UnknownSurrogate):
        add("t")


def test_a_session_record_with_a_long_expired_lease_is_deleted(storage: Storage, add, until: Until) -> None:
    add("s", seconds=SHORT)
    add("t")
    assert storage.part(LiveSessions).sweep(LONG) == 0
    until(lambda: storage.part(LiveSessions).sweep(SHORT) == 1)
    assert storage.part(LiveSessions).holder("s") is None
    assert storage.part(LiveSessions).holder("t") is not None


def test_a_session_lease_expires_although_the_database_clock_is_set_back(
    storage: Storage, add, set_clock_back: Callable[[float], None]
) -> None:
    add()
    set_clock_back(DAY)
    assert seconds_left(storage, "s") > LONG
    storage.part(LiveSessions).sweep(LONG)
    assert LONG / 2 < seconds_left(storage, "s") <= LONG


def seconds_left(storage: Storage, id: str) -> float:
    holder = storage.part(LiveSessions).holder(id)
    assert holder is not None
    return holder.seconds_left
