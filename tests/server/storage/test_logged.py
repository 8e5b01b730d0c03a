"""Logged samples: known by their numbers, apart from the budget, fitted without waiting for queries."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from surrogym_server.errors import InvalidInput
from surrogym_server.storage.port import Storage
from surrogym_server.storage.records import LedgerRecord, NewDesign, NewSample, QueryCounts

SECONDS = 60.0
Make = Callable[..., str]
Sample = Callable[..., NewSample]


def test_logged_samples_have_their_own_line_and_cost_no_budget(storage: Storage, make: Make, by_hand: Sample) -> None:
    name = make(queries=0, budget=3)
    storage.samples.add(name, "log", [by_hand(reward=float(i)) for i in range(10)], logged=True)
    assert storage.ledger.read(name) == LedgerRecord(logged=10)
    assert (storage.ledger.read(name).total, storage.ledger.read(name).samples) == (0, 10)
    assert storage.designs.left(name) == 3
    assert {sample.purpose for sample in storage.samples.page(name, 0, 20)} == {"logged"}
    assert set(storage.samples.arrays(name).purpose) == {"logged"}


def test_arrays_tell_logged_samples_from_others(storage: Storage, make: Make, by_hand: Sample) -> None:
    name = make(queries=0)
    storage.samples.add(name, "log", [by_hand(reward=1.0)], logged=True)
    storage.samples.add(name, "hand", [by_hand(reward=1.0)], key="one")
    assert storage.samples.arrays(name).purpose == ("logged", "manual")
    assert storage.ledger.read(name) == LedgerRecord(manual=1, logged=1)


def test_the_same_log_in_other_batches_changes_nothing(storage: Storage, make: Make, by_hand: Sample) -> None:
    name = make(queries=0)
    log = [by_hand(reward=float(i)) for i in range(4)]
    first = storage.samples.add(name, "log", log, logged=True)
    again = [storage.samples.add(name, "other", part, logged=True) for part in (log[:1], log[1:])]
    assert [id for added in again for id in added.ids] == list(first.ids)
    assert [added.duplicates for added in again] == [1, 3]
    assert storage.samples.count(name) == 4


def test_a_row_twice_in_a_batch_is_stored_once(storage: Storage, make: Make, by_hand: Sample) -> None:
    name = make(queries=0)
    added = storage.samples.add(name, "log", [by_hand(), by_hand()], logged=True)
    assert (len(set(added.ids)), added.duplicates) == (1, 1)


def test_a_log_is_fitted_while_queries_wait_for_a_sampler(
    storage: Storage, make: Make, by_hand: Sample, design: Callable[..., NewDesign]
) -> None:
    name = make(queries=3)
    assert storage.designs.due() == []
    storage.samples.add(name, "log", [by_hand()], logged=True)
    assert storage.designs.due() == [name]
    lease = storage.designs.begin(name, "me", SECONDS)
    assert lease is not None
    storage.designs.commit(lease, design(queries=1))
    assert storage.designs.due() == [], "the log has been looked at, and queries are open"
    storage.samples.add(name, "log", [by_hand(reward=2.0)], logged=True)
    assert storage.designs.due() == [name]


def test_no_fit_is_due_before_the_log_is_complete(storage: Storage, make: Make, by_hand: Sample) -> None:
    name = make(queries=0)
    storage.samples.add(name, "log", [by_hand()], logged=True, complete=False)
    assert storage.designs.due() == []
    storage.samples.add(name, "log", [by_hand()], logged=True)  # nothing new comes with the end
    assert storage.designs.due() == [name]


def test_a_repeated_complete_log_makes_no_fit_due(
    storage: Storage, make: Make, by_hand: Sample, design: Callable[..., NewDesign]
) -> None:
    name = make(queries=0)
    storage.samples.add(name, "log", [by_hand()], logged=True)
    lease = storage.designs.begin(name, "me", SECONDS)
    assert lease is not None
    storage.designs.commit(lease, design(phase="from_log"))
    storage.samples.add(name, "log", [by_hand()], logged=True)
    assert storage.designs.due() == []
    assert storage.surrogates.get(name).phase == "from_log"


def test_a_logged_sample_of_a_query_is_refused_by_its_index(
    storage: Storage, make: Make, by_hand: Sample, answer: Sample
) -> None:
    name = make(queries=1)
    [leased] = storage.queries.claim(name, "a", 1, SECONDS)
    with pytest.raises(InvalidInput, match=r"samples\.1: expected a logged sample without a query_id"):
        storage.samples.add(name, "log", [by_hand(), answer(leased)], logged=True)
    assert storage.samples.count(name) == 0


def test_only_queries_without_a_lease_are_withdrawn(storage: Storage, make: Make, answer: Sample) -> None:
    name = make(queries=4)
    ids = [query.id for query in storage.queries.list(name)]
    answered, failed = storage.queries.claim(name, "a", 2, SECONDS)
    storage.samples.add(name, "a", [answer(answered)])
    storage.queries.fail(name, failed.id, failed.token, "it broke")
    assert storage.queries.withdraw(name, ids) == 2
    assert storage.queries.counts(name) == QueryCounts(pending=1, answered=1)
    assert storage.queries.withdraw(name, ids) == 0
