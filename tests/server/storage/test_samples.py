"""Samples: kept once acknowledged, counted once, all of a batch or none."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from surrogym_server.errors import ForeignLease, IdempotencyConflict, InvalidInput, UnknownQuery
from surrogym_server.storage.records import LedgerRecord, NewSample, QueryCounts
from surrogym_server.storage.sql import Storage

LONG = 60.0
SHORT = 0.02
Wait = Callable[[Callable[[], bool]], None]


def test_a_sample_answers_its_query_and_gets_its_purpose(
    storage: Storage, make: Callable[..., str], answer: Callable[..., NewSample]
) -> None:
    name = make(queries=1)
    [leased] = storage.queries.claim(name, "a", 1, LONG)
    achieved = (0.01, 1.01)
    added = storage.samples.add(name, "a", [answer(leased, coordinates=achieved, observation=(1.0, 0.0, 2.0))])
    [sample] = storage.samples.page(name, 0, 10)
    assert (added.ids, added.duplicates) == ((sample.id,), 0)
    assert (sample.purpose, sample.query_id, sample.attempt, sample.late) == ("initial", leased.id, 1, False)
    assert (sample.coordinates, sample.requested_coordinates) == (achieved, leased.coordinates)
    assert (sample.observation, sample.next_observation) == ((1.0, 0.0, 2.0), None)
    assert storage.surrogates.summary(name).queries == QueryCounts(answered=1)
    assert storage.ledger.read(name) == LedgerRecord(initial=1)


def test_a_sample_without_a_query_gets_the_purpose_manual(
    storage: Storage, make: Callable[..., str], by_hand: Callable[..., NewSample]
) -> None:
    name = make(queries=0)
    storage.samples.add(name, "a", [by_hand(), by_hand()])
    assert [(s.purpose, s.query_id, s.attempt) for s in storage.samples.page(name, 0, 10)] == 2 * [("manual", None, 0)]
    assert storage.ledger.read(name).manual == 2


def test_answering_a_query_again_returns_the_same_sample_id(
    storage: Storage, make: Callable[..., str], answer: Callable[..., NewSample]
) -> None:
    name = make(queries=2)
    first, second = storage.queries.claim(name, "a", 2, LONG)
    before = storage.samples.add(name, "a", [answer(first)])
    after = storage.samples.add(name, "a", [answer(first), answer(second)])
    assert after.ids[0] == before.ids[0]
    assert after.duplicates == 1
    assert storage.samples.count(name) == 2


def test_the_seconds_of_a_step_are_stored_and_make_no_other_sample_of_it(
    storage: Storage, make: Callable[..., str], answer: Callable[..., NewSample]
) -> None:
    name = make(queries=1)
    [leased] = storage.queries.claim(name, "a", 1, LONG)
    storage.samples.add(name, "a", [answer(leased, seconds=0.05)])
    assert storage.samples.add(name, "a", [answer(leased)]).duplicates == 1
    [sample] = storage.samples.page(name, 0, 10)
    assert sample.seconds == 0.05


def test_another_answer_under_the_same_lease_is_refused(
    storage: Storage, make: Callable[..., str], answer: Callable[..., NewSample]
) -> None:
    name = make(queries=1)
    [leased] = storage.queries.claim(name, "a", 1, LONG)
    storage.samples.add(name, "a", [answer(leased)])
    with pytest.raises(IdempotencyConflict, match=f"query {leased.id}"):
        storage.samples.add(name, "a", [answer(leased, reward=99.0)])
    assert storage.samples.page(name, 0, 10)[0].reward == -1.25


def test_a_lease_answered_twice_in_one_batch_stores_one_sample(
    storage: Storage, make: Callable[..., str], answer: Callable[..., NewSample]
) -> None:
    name = make(queries=1)
    [leased] = storage.queries.claim(name, "a", 1, LONG)
    with pytest.raises(IdempotencyConflict):
        storage.samples.add(name, "a", [answer(leased), answer(leased, reward=2.0)])
    added = storage.samples.add(name, "a", [answer(leased), answer(leased)])
    assert added.ids[0] == added.ids[1]
    assert added.duplicates == 1


def test_samples_repeated_under_one_idempotency_key_are_stored_once_and_changed_ones_refused(
    storage: Storage, make: Callable[..., str], by_hand: Callable[..., NewSample]
) -> None:
    name = make(queries=0)
    batch = [by_hand(1.0), by_hand(2.0)]
    before = storage.samples.add(name, "a", batch, key="k")
    after = storage.samples.add(name, "a", batch, key="k")
    assert (after.ids, after.duplicates) == (before.ids, 2)
    with pytest.raises(IdempotencyConflict, match="'k'"):
        storage.samples.add(name, "a", batch[:1], key="k")
    assert storage.samples.count(name) == 2


def test_idempotency_keys_of_samples_are_separate_for_each_surrogate(
    storage: Storage, make: Callable[..., str], by_hand: Callable[..., NewSample]
) -> None:
    one, two = make(queries=0, name="one"), make(queries=0, name="two")
    storage.samples.add(one, "a", [by_hand(1.0)], key="k")
    storage.samples.add(two, "a", [by_hand(2.0)], key="k")
    assert storage.samples.count(two) == 1


@pytest.mark.parametrize("broken", ["foreign", "missing", "unknown", "conflict"])
def test_a_batch_with_one_invalid_sample_stores_none(
    storage: Storage,
    make: Callable[..., str],
    answer: Callable[..., NewSample],
    by_hand: Callable[..., NewSample],
    broken: str,
) -> None:
    name = make(queries=3)
    good, bad, done = storage.queries.claim(name, "a", 3, LONG)
    storage.samples.add(name, "a", [answer(done)])
    events = storage.events.list(name)
    last, error = {
        "foreign": (answer(bad, lease_token=good.token), ForeignLease),
        "missing": (answer(bad, lease_token=None), ForeignLease),
        "unknown": (answer(bad, query_id=10**6), UnknownQuery),
        "conflict": (answer(done, reward=7.0), IdempotencyConflict),
    }[broken]
    with pytest.raises(error):
        storage.samples.add(name, "a", [by_hand(), answer(good), last], key="k")
    assert storage.samples.count(name) == 1
    assert storage.queries.get(name, good.id).status == "leased"
    assert storage.events.list(name) == events
    assert storage.samples.add(name, "a", [by_hand(), answer(good)], key="k").duplicates == 0, "the key is still free"


def test_a_sample_with_a_lease_token_but_no_query_id_is_refused(
    storage: Storage, make: Callable[..., str], by_hand: Callable[..., NewSample]
) -> None:
    with pytest.raises(InvalidInput, match="query_id"):
        storage.samples.add(make(), "a", [by_hand(lease_token="t")])


def test_a_late_sample_is_stored_once_and_answers_the_pending_query(
    storage: Storage, make: Callable[..., str], answer: Callable[..., NewSample], until: Wait
) -> None:
    name = make(queries=1)
    [leased] = storage.queries.claim(name, "slow", 1, SHORT)
    until(lambda: storage.queries.sweep_expired() == 1)
    late = storage.samples.add(name, "slow", [answer(leased)])
    assert storage.samples.add(name, "slow", [answer(leased)]).ids == late.ids
    [sample] = storage.samples.page(name, 0, 10)
    assert (sample.late, sample.purpose) == (True, "initial")
    assert storage.surrogates.summary(name).queries == QueryCounts(answered=1)
    assert storage.queries.claim(name, "b", 1, LONG) == []
    assert storage.ledger.read(name) == LedgerRecord(initial=1), "it is resolved now"


def test_a_sample_after_lease_expiry_is_late_even_before_the_lease_is_swept(
    storage: Storage, make: Callable[..., str], answer: Callable[..., NewSample], until: Wait
) -> None:
    name = make(queries=1)
    [leased] = storage.queries.claim(name, "slow", 1, SHORT)
    until(lambda: storage.ledger.read(name).unresolved == 1)
    storage.samples.add(name, "slow", [answer(leased)])
    assert storage.samples.page(name, 0, 1)[0].late
    assert storage.queries.sweep_expired() == 0
    assert storage.surrogates.summary(name).queries == QueryCounts(answered=1)


def test_a_late_sample_does_not_end_the_lease_of_the_next_sampler(
    storage: Storage, make: Callable[..., str], answer: Callable[..., NewSample], until: Wait
) -> None:
    name = make(queries=1)
    [slow] = storage.queries.claim(name, "slow", 1, SHORT)
    until(lambda: storage.queries.sweep_expired() == 1)
    [quick] = storage.queries.claim(name, "quick", 1, LONG)
    storage.samples.add(name, "slow", [answer(slow, reward=1.0)])
    assert storage.surrogates.summary(name).queries == QueryCounts(leased=1)
    storage.samples.add(name, "quick", [answer(quick, reward=2.0)])
    assert storage.surrogates.summary(name).queries == QueryCounts(answered=1)
    samples = storage.samples.page(name, 0, 10)
    assert [(s.sampler, s.attempt, s.late, s.reward) for s in samples] == [
        ("slow", 1, True, 1.0),
        ("quick", 2, False, 2.0),
    ]


def test_the_sweep_of_expired_leases_does_not_requeue_a_query_answered_late(
    storage: Storage, make: Callable[..., str], answer: Callable[..., NewSample], until: Wait
) -> None:
    name = make(queries=1)
    [slow] = storage.queries.claim(name, "slow", 1, SHORT)
    until(lambda: storage.queries.sweep_expired() == 1)
    storage.queries.claim(name, "dead", 1, SHORT)
    until(lambda: storage.ledger.read(name).unresolved == 2)
    storage.samples.add(name, "slow", [answer(slow)])
    assert storage.queries.sweep_expired() == 1
    assert storage.surrogates.summary(name).queries == QueryCounts(answered=1)
    assert storage.ledger.read(name).unresolved == 1


def test_a_late_sample_for_an_answered_query_is_stored(
    storage: Storage, make: Callable[..., str], answer: Callable[..., NewSample], until: Wait
) -> None:
    name = make(queries=1)
    [slow] = storage.queries.claim(name, "slow", 1, SHORT)
    until(lambda: storage.queries.sweep_expired() == 1)
    [quick] = storage.queries.claim(name, "quick", 1, LONG)
    storage.samples.add(name, "quick", [answer(quick)])
    storage.samples.add(name, "slow", [answer(slow)])
    assert [sample.late for sample in storage.samples.page(name, 0, 10)] == [False, True]
    assert storage.surrogates.summary(name).queries == QueryCounts(answered=1)


def test_a_sample_after_a_reported_failure_is_stored_as_late(
    storage: Storage, make: Callable[..., str], answer: Callable[..., NewSample]
) -> None:
    name = make(queries=1)
    [leased] = storage.queries.claim(name, "a", 1, LONG)
    storage.queries.fail(name, leased.id, leased.token, "no reply from the robot")
    storage.samples.add(name, "a", [answer(leased)])
    assert storage.samples.page(name, 0, 1)[0].late
    assert storage.queries.get(name, leased.id).status == "answered"


def test_sample_arrays_contain_all_samples_in_order_bit_exactly(
    storage: Storage, make: Callable[..., str], by_hand: Callable[..., NewSample]
) -> None:
    name = make(queries=0)
    empty = storage.samples.arrays(name)
    assert (len(empty.coordinates), len(empty.reward)) == (0, 0)
    rows = np.random.default_rng(0).normal(size=(50, 6))
    for row in rows:
        q, u, q_next = tuple(row[:2].tolist()), (float(row[2]),), tuple(row[3:5].tolist())
        sample = by_hand(float(row[5]), coordinates=q, action=u, next_coordinates=q_next)
        storage.samples.add(name, "a", [replace(sample, terminated=bool(row[5] > 0))])
    got = storage.samples.arrays(name)
    columns = (got.coordinates, got.action, got.next_coordinates, got.reward[:, None])
    assert np.hstack(columns).tobytes() == rows.tobytes()
    assert got.terminated.tolist() == (rows[:, 5] > 0).tolist()


def test_a_page_of_samples_starts_after_the_given_id(
    storage: Storage, make: Callable[..., str], by_hand: Callable[..., NewSample]
) -> None:
    name = make(queries=0)
    other = make(queries=0, name="other")
    storage.samples.add(other, "a", [by_hand()])
    ids = storage.samples.add(name, "a", [by_hand(float(i)) for i in range(5)]).ids
    first = storage.samples.page(name, 0, 3)
    rest = storage.samples.page(name, first[-1].id, 3)
    assert tuple(sample.id for sample in first + rest) == ids
    assert [sample.reward for sample in first + rest] == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert storage.samples.page(name, ids[-1], 3) == []


def test_evaluation_steps_are_counted_once_per_idempotency_key_and_apart_from_samples(
    storage: Storage, make: Callable[..., str]
) -> None:
    name = make()
    storage.ledger.report(name, 200, key="k", episodes=1)
    assert storage.ledger.report(name, 200, key="k", episodes=1).evaluation == 200
    with pytest.raises(IdempotencyConflict):
        storage.ledger.report(name, 300, key="k", episodes=1)
    ledger = storage.ledger.report(name, 50, key="another")
    assert (ledger.evaluation, ledger.total) == (250, 0)
