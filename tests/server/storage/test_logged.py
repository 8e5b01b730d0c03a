"""Logged samples: known by their place in their log, apart from the budget, fitted without waiting for queries."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from surrogym_server.errors import InvalidInput
from surrogym_server.storage.records import LedgerRecord, LogPart, NewDesign, NewSample, QueryCounts
from surrogym_server.storage.sql import Storage

SECONDS = 60.0
Make = Callable[..., str]
Sample = Callable[..., NewSample]


def test_logged_samples_are_counted_separately_in_the_ledger_and_cost_no_budget(
    storage: Storage, make: Make, by_hand: Sample
) -> None:
    name = make(queries=0, budget=3)
    storage.samples.add(name, "log", [by_hand(reward=float(i)) for i in range(10)], log=LogPart())
    assert storage.ledger.read(name) == LedgerRecord(logged=10)
    assert (storage.ledger.read(name).total, storage.ledger.read(name).samples) == (0, 10)
    assert storage.designs.left(name) == 3
    assert {sample.purpose for sample in storage.samples.page(name, 0, 20)} == {"logged"}
    assert set(storage.samples.arrays(name).purpose) == {"logged"}


def test_sample_arrays_mark_logged_samples_by_their_purpose(storage: Storage, make: Make, by_hand: Sample) -> None:
    name = make(queries=0)
    storage.samples.add(name, "log", [by_hand(reward=1.0)], log=LogPart())
    storage.samples.add(name, "hand", [by_hand(reward=1.0)], key="one")
    assert storage.samples.arrays(name).purpose == ("logged", "manual")
    assert storage.ledger.read(name) == LedgerRecord(manual=1, logged=1)


def test_sending_the_same_log_again_in_other_batches_stores_nothing(
    storage: Storage, make: Make, by_hand: Sample
) -> None:
    name = make(queries=0)
    log = [by_hand(reward=float(i)) for i in range(4)]
    first = storage.samples.add(name, "log", log, log=LogPart())
    begin = storage.samples.add(name, "other", log[:1], log=LogPart(complete=False))
    end = storage.samples.add(name, "other", log[1:], log=LogPart(begin.digest))
    assert begin.ids + end.ids == first.ids
    assert (begin.duplicates, end.duplicates, end.digest) == (1, 3, first.digest)
    assert storage.samples.count(name) == 4


def test_equal_rows_within_a_log_are_all_stored(storage: Storage, make: Make, by_hand: Sample) -> None:
    """1,864 of 1,999 steps were dropped because they had the numbers of others."""
    name = make(queries=0)
    for _ in range(2):
        added = storage.samples.add(name, "log", [by_hand()] * 3, log=LogPart())
        assert len(set(added.ids)) == 3
    assert (added.duplicates, storage.samples.count(name)) == (3, 3)


def sent(storage: Storage, name: str, log: list[NewSample], size: int, after: str | None = None) -> int:
    """Send a log in parts, and return the number of its duplicates."""
    first, duplicates, place = 0, 0, after
    while first < len(log):
        part = log[first : first + size]
        added = storage.samples.add(name, "log", part, log=LogPart(place, complete=first + size >= len(log)))
        if added.restart is not None:
            first, duplicates, place = 0, 0, added.restart
        else:
            first, duplicates, place = first + size, duplicates + added.duplicates, added.digest
    return duplicates


@pytest.mark.parametrize("size", [2, 100])
def test_random_logs_sent_in_any_pieces_are_each_stored_once(
    storage: Storage, make: Make, by_hand: Sample, size: int
) -> None:
    """Logs of few different steps, which begin alike, grow, are interrupted and come again."""
    rng = np.random.default_rng(size)
    for draw in range(4):
        name, stored = make(name=f"drawn-{draw}", queries=0), dict[int, int]()
        logs = [[by_hand(reward=float(r)) for r in rng.integers(0, 2, 12).tolist()] for _ in range(4)]
        assert len({tuple(one.reward for one in log) for log in logs}) == len(logs)
        for _ in range(8):
            which, upto = int(rng.integers(0, 4)), int(rng.choice([5, 9, 12]))
            before = stored.get(which, 0)
            if any(_begins(logs[which][: max(upto, before)], logs[k][:n]) for k, n in stored.items() if k != which):
                continue  # a part that is the beginning of another log can't be told from it
            duplicates = sent(storage, name, logs[which][:upto], size)
            assert duplicates == min(before, upto), (draw, which, upto, stored)
            stored[which] = max(before, upto)
        assert storage.samples.count(name) == sum(stored.values())


def _begins(one: list[NewSample], other: list[NewSample]) -> bool:
    """Whether one of two logs is the beginning of the other."""
    return all(a == b for a, b in zip(one, other, strict=False))


def test_equal_logs_of_different_origin_are_both_stored(storage: Storage, make: Make, by_hand: Sample) -> None:
    """Two days of a plant at rest have the same numbers."""
    name, day = make(queries=0), [by_hand()] * 3
    assert [sent(storage, name, day, 2, origin) for origin in ("monday", "tuesday", "monday")] == [0, 0, 3]
    assert storage.samples.count(name) == 6


def test_a_fit_to_a_log_is_due_although_queries_are_open(
    storage: Storage, make: Make, by_hand: Sample, design: Callable[..., NewDesign]
) -> None:
    name = make(queries=3)
    assert storage.designs.due() == []
    storage.samples.add(name, "log", [by_hand()], log=LogPart())
    assert storage.designs.due() == [name]
    lease = storage.designs.begin(name, "me", SECONDS)
    assert lease is not None
    storage.designs.commit(lease, design(queries=1))
    assert storage.designs.due() == [], "the log has been looked at, and queries are open"
    storage.samples.add(name, "log", [by_hand(reward=2.0)], log=LogPart())
    assert storage.designs.due() == [name]


def test_no_fit_is_due_before_a_log_in_parts_is_complete(storage: Storage, make: Make, by_hand: Sample) -> None:
    name = make(queries=0)
    storage.samples.add(name, "log", [by_hand()], log=LogPart(complete=False))
    assert storage.designs.due() == []
    storage.samples.add(name, "log", [by_hand()], log=LogPart())  # nothing new comes with the end
    assert storage.designs.due() == [name]


def test_sending_a_complete_log_again_triggers_no_new_fit(
    storage: Storage, make: Make, by_hand: Sample, design: Callable[..., NewDesign]
) -> None:
    name = make(queries=0)
    storage.samples.add(name, "log", [by_hand()], log=LogPart())
    lease = storage.designs.begin(name, "me", SECONDS)
    assert lease is not None
    storage.designs.commit(lease, design(phase="from_log"))
    storage.samples.add(name, "log", [by_hand()], log=LogPart())
    assert storage.designs.due() == []
    assert storage.surrogates.get(name).phase == "from_log"


def test_a_logged_sample_with_a_query_id_is_refused_with_its_index(
    storage: Storage, make: Make, by_hand: Sample, answer: Sample
) -> None:
    name = make(queries=1)
    [leased] = storage.queries.claim(name, "a", 1, SECONDS)
    with pytest.raises(InvalidInput, match=r"samples\.1: expected no query_id"):
        storage.samples.add(name, "log", [by_hand(), answer(leased)], log=LogPart())
    assert storage.samples.count(name) == 0


def test_withdrawing_queries_leaves_leased_failed_and_answered_ones(
    storage: Storage, make: Make, answer: Sample
) -> None:
    name = make(queries=4)
    ids = [query.id for query in storage.queries.list(name)]
    answered, failed = storage.queries.claim(name, "a", 2, SECONDS)
    storage.samples.add(name, "a", [answer(answered)])
    storage.queries.fail(name, failed.id, failed.token, "it broke")
    assert storage.queries.withdraw(name, ids) == 2
    assert storage.surrogates.summary(name).queries == QueryCounts(pending=1, answered=1)
    assert storage.queries.withdraw(name, ids) == 0
