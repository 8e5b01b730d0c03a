"""Snapshots: known with the sample that made them, forgotten with the queries that begin there."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from surrogym_server.errors import UnknownSurrogate
from surrogym_server.storage.records import LeasedQuery, NewDesign, NewSample, QueryCounts
from surrogym_server.storage.sql import Storage
from surrogym_shared.nouns import Query

LONG = 60.0
FIRST = (Query.rollout([[0.5], [-0.5], [1 / 3]]),)
NEXT = (Query.rollout([[0.5], [0.25]], "one"), Query.rollout([[2.0]], "two"), Query.rollout([[1.0]]))
Answer = Callable[..., NewSample]


@pytest.fixture
def name(make: Callable[..., str]) -> str:
    return make(queries=FIRST)


@pytest.fixture
def first(storage: Storage, name: str) -> LeasedQuery:
    return storage.queries.claim(name, "a", 1, LONG)[0]


@pytest.fixture
def known(storage: Storage, name: str, first: LeasedQuery, answer: Answer) -> list[NewSample]:
    """A rollout of three samples; the states after the first two were saved."""
    samples = [answer(first, step=i, snapshot=snapshot) for i, snapshot in enumerate(("one", "two", None))]
    storage.samples.add(name, "a", samples)
    return samples


@pytest.fixture
def chosen(storage: Storage, name: str, known: list[NewSample], design: Callable[..., NewDesign]) -> list[LeasedQuery]:
    """Three queries of the design: two begin at a snapshot, the last one at a reset. No sampler has begun them."""
    del known
    lease = storage.designs.begin(name, "server", LONG)
    assert lease is not None
    storage.designs.commit(lease, design(queries=NEXT))
    queries = storage.queries.claim(name, "a", 3, LONG)
    for query in queries:
        storage.queries.fail(name, query.id, query.token, "later", begun=False)
    return queries


def test_a_snapshot_is_stored_with_the_state_after_its_step(
    storage: Storage, name: str, known: list[NewSample]
) -> None:
    expected = {"one": known[0].next_coordinates, "two": known[1].next_coordinates}
    assert storage.snapshots.all(name) == expected
    storage.samples.add(name, "a", known)
    assert storage.snapshots.all(name) == expected, "a repeat changes nothing"


def test_a_rollout_query_names_the_snapshot_it_starts_from(
    storage: Storage, name: str, chosen: list[LeasedQuery]
) -> None:
    assert [query.snapshot for query in chosen] == ["one", "two", None]
    assert [query.snapshot for query in storage.queries.list(name)] == [None, "one", "two", None]


def test_dropping_a_snapshot_withdraws_its_queries_and_makes_a_fit_due(
    storage: Storage, name: str, chosen: list[LeasedQuery]
) -> None:
    storage.queries.withdraw(name, [query.id for query in chosen[1:]])
    assert storage.designs.due() == []
    assert storage.snapshots.drop(name, ["one", "never"]) == 1
    assert list(storage.snapshots.all(name)) == ["two"]
    assert storage.surrogates.summary(name).queries == QueryCounts(answered=1)
    assert storage.designs.due() == [name]
    assert storage.snapshots.drop(name, ["one"]) == 0, "a repeat is harmless"


def test_a_repeated_sample_does_not_restore_a_dropped_snapshot(
    storage: Storage, name: str, known: list[NewSample]
) -> None:
    storage.snapshots.drop(name, ["one"])
    storage.samples.add(name, "a", known)
    assert list(storage.snapshots.all(name)) == ["two"]


def test_a_leased_query_whose_snapshot_was_dropped_is_not_handed_out_again(
    storage: Storage, name: str, chosen: list[LeasedQuery]
) -> None:
    first, second, third = storage.queries.claim(name, "a", 3, LONG)
    storage.snapshots.drop(name, ["one"])
    assert storage.surrogates.summary(name).queries.leased == 3, "its sampler may have returned to it before"
    for query in (first, second, third):
        storage.queries.fail(name, query.id, query.token, "gone", begun=False)
    left = storage.queries.claim(name, "b", 3, LONG)
    assert [query.id for query in left] == [query.id for query in chosen[1:]]
    assert storage.ledger.read(name).unresolved == 0


def test_a_possibly_started_query_is_set_aside_when_its_snapshot_is_dropped(
    storage: Storage, name: str, chosen: list[LeasedQuery]
) -> None:
    again = storage.queries.claim(name, "a", 1, LONG)[0]
    storage.queries.fail(name, again.id, again.token, "it shook")
    storage.snapshots.drop(name, ["one"])
    query = storage.queries.get(name, chosen[0].id)
    assert (query.status, query.error) == ("set_aside", "its snapshot is gone")
    assert storage.ledger.read(name).unresolved == 2, "its two steps may have been taken"


def test_deleting_a_surrogate_deletes_its_snapshots(storage: Storage, name: str, known: list[NewSample]) -> None:
    storage.surrogates.delete(name)
    for call in (lambda: storage.snapshots.all(name), lambda: storage.snapshots.drop(name, ["one"])):
        with pytest.raises(UnknownSurrogate):
            call()
