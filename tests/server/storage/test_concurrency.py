"""Many threads at once: nothing is handed out, fitted or counted twice."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from typing import TypeVar

import pytest

from surrogym_server.storage.records import NewSample, NewSurrogate, QueryCounts
from surrogym_server.storage.sql import Storage, open_storage

T = TypeVar("T")

THREADS = 6
LONG = 60.0


def at_once(work: Callable[[int], T]) -> list[T]:
    """Start the same work in all threads at the same moment."""
    gate = threading.Barrier(THREADS)

    def run(number: int) -> T:
        gate.wait()
        return work(number)

    with ThreadPoolExecutor(THREADS) as threads:
        return list(threads.map(run, range(THREADS)))


def test_samplers_that_fetch_queries_concurrently_never_get_the_same_one(
    storage: Storage, make: Callable[..., str], answer: Callable[..., NewSample]
) -> None:
    name = make(queries=60)

    def work(number: int) -> list[int]:
        mine: list[int] = []
        while claimed := storage.queries.claim(name, f"w{number}", 2, LONG):
            storage.samples.add(name, f"w{number}", [answer(query) for query in claimed])
            mine += [query.id for query in claimed]
        return mine

    ids = [id for mine in at_once(work) for id in mine]
    assert len(ids) == len(set(ids)) == 60
    assert storage.surrogates.summary(name).queries == QueryCounts(answered=60)
    assert storage.samples.count(name) == 60


def test_one_of_several_concurrent_threads_gets_the_fit_lease(
    storage: Storage, make: Callable[..., str], answer_all: Callable[[str], None]
) -> None:
    name = make()
    answer_all(name)
    leases = at_once(lambda number: storage.designs.begin(name, f"server {number}", LONG))
    assert sum(lease is not None for lease in leases) == 1


def test_identical_concurrent_reports_store_one_sample(
    storage: Storage, make: Callable[..., str], answer: Callable[..., NewSample]
) -> None:
    name = make(queries=1)
    [leased] = storage.queries.claim(name, "a", 1, LONG)
    added = at_once(lambda _: storage.samples.add(name, "a", [answer(leased)], key="k"))
    assert len({one.ids for one in added}) == 1
    assert sum(one.duplicates for one in added) == THREADS - 1
    assert storage.samples.count(name) == 1


def test_identical_concurrent_requests_create_one_surrogate(storage: Storage) -> None:
    made = at_once(lambda _: storage.surrogates.create(NewSurrogate("a", {"x": 1}, 30, 0.9)))
    assert sum(created for _, created in made) == 1


def test_a_reader_of_events_misses_none_during_concurrent_writes(
    storage: Storage, make: Callable[..., str], by_hand: Callable[..., NewSample]
) -> None:
    name = make(queries=0)
    writers = threading.Semaphore(0)

    def write() -> list[int]:
        for _ in range(10):
            storage.samples.add(name, "a", [by_hand()])
        writers.release()
        return []

    def read() -> list[int]:
        seen, finished = [0], 0
        while finished < THREADS - 1:
            finished += writers.acquire(blocking=False)
            seen += [event.id for event in storage.events.list(name, after=seen[-1])]
        return seen[1:]

    [seen, *_] = at_once(lambda number: write() if number else read())
    assert seen == [event.id for event in storage.events.list(name)]


@pytest.mark.postgresql
@pytest.mark.parametrize("url", ["postgresql"], indirect=True)
def test_several_servers_can_use_one_postgresql_and_one_gets_the_fit_lease(
    url: str, answer: Callable[..., NewSample], by_hand: Callable[..., NewSample]
) -> None:
    with ThreadPoolExecutor(THREADS) as threads, ExitStack() as stack:
        servers = list(threads.map(lambda _: open_storage(url), range(THREADS)))
        for server in servers:
            stack.callback(server.close)
        servers[0].surrogates.create(NewSurrogate("a", {}, 30, 0.9))
        at_once(lambda number: servers[number].samples.add("a", "w", [by_hand()]))
        leases = at_once(lambda number: servers[number].designs.begin("a", f"server {number}", LONG))
    assert sum(lease is not None for lease in leases) == 1
