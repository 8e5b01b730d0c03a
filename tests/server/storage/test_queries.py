"""The queue: each query to one sampler at a time, never lost with it, set aside when it keeps failing."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from support.queries import steps
from surrogym_server.errors import ForeignLease, IdempotencyConflict, LeaseExpired, UnknownQuery
from surrogym_server.storage.records import LedgerRecord, NewSample, QueryCounts
from surrogym_server.storage.sql import Storage
from surrogym_server.storage.sql.queries import MAX_ATTEMPTS

LONG = 60.0
SHORT = 0.02


def test_each_query_is_handed_out_once_and_the_oldest_first(storage: Storage, make: Callable[..., str]) -> None:
    name = make(queries=3)
    first = storage.queries.claim(name, "a", 2, LONG)
    second = storage.queries.claim(name, "b", 2, LONG)
    ids = [query.id for query in first + second]
    assert ids == sorted(ids)
    assert len(set(ids)) == 3
    assert storage.queries.claim(name, "c", 2, LONG) == []
    assert {query.attempt for query in first + second} == {1}
    assert storage.surrogates.summary(name).queries == QueryCounts(leased=3)


def test_a_leased_query_names_its_sampler(storage: Storage, make: Callable[..., str]) -> None:
    name = make(queries=1)
    [leased] = storage.queries.claim(name, "arm-7", 1, LONG)
    query = storage.queries.get(name, leased.id)
    assert (query.status, query.sampler, query.attempts) == ("leased", "arm-7", 1)


def test_a_leased_query_contains_the_expiry_of_its_lease(storage: Storage, make: Callable[..., str]) -> None:
    name = make(queries=2)
    [failed] = storage.queries.claim(name, "a", 1, LONG)
    storage.queries.fail(name, failed.id, failed.token, "dropped")
    [leased] = storage.queries.claim(name, "b", 1, LONG)
    left = {query.id: query.lease_seconds_left for query in storage.queries.list(name)}
    assert left.keys() == {failed.id, failed.id + 1}
    assert LONG - 5 < left[leased.id] <= LONG
    assert [seconds for id, seconds in left.items() if id != leased.id] == [None]


def test_query_coordinates_are_stored_bit_exactly(storage: Storage, make: Callable[..., str]) -> None:
    name = make(queries=0)
    odd = np.array([[0.1 + 0.2, -0.0], [5e-324, 1.7976931348623157e308]])
    storage.queries.enqueue(name, steps(odd, [[np.pi], [1 / 3]]))
    claimed = storage.queries.claim(name, "a", 2, LONG)
    assert np.array([query.coordinates for query in claimed]).tobytes() == odd.tobytes()
    assert [query.action for query in claimed] == [(np.pi,), (1 / 3,)]


def test_no_query_of_a_paused_surrogate_is_handed_out(storage: Storage, make: Callable[..., str]) -> None:
    name = make()
    storage.surrogates.change(name, paused=True)
    assert storage.queries.claim(name, "a", 1, LONG) == []
    storage.surrogates.change(name, paused=False)
    assert len(storage.queries.claim(name, "a", 1, LONG)) == 1


def test_the_query_of_a_dead_sampler_goes_to_the_next_sampler(
    storage: Storage, make: Callable[..., str], until: Callable[[Callable[[], bool]], None]
) -> None:
    name = make(queries=1)
    [lost] = storage.queries.claim(name, "dead", 1, SHORT)
    claims = []
    until(lambda: bool(claims.extend(storage.queries.claim(name, "next", 1, LONG)) or claims))
    assert (claims[0].id, claims[0].attempt) == (lost.id, 2)
    assert claims[0].token != lost.token
    assert storage.ledger.read(name).unresolved == 1


def test_a_query_with_an_expired_lease_counts_as_an_unresolved_real_step_at_once(
    storage: Storage, make: Callable[..., str], until: Callable[[Callable[[], bool]], None]
) -> None:
    name = make(queries=1)
    storage.queries.claim(name, "dead", 1, SHORT)
    until(lambda: storage.ledger.read(name).unresolved == 1)
    assert storage.surrogates.summary(name).queries.leased == 1
    assert storage.queries.sweep_expired() == 1
    assert storage.queries.sweep_expired() == 0
    assert storage.surrogates.summary(name).queries.pending == 1
    assert storage.ledger.read(name).unresolved == 1


def test_renewing_a_query_lease_prevents_its_expiry(
    storage: Storage, make: Callable[..., str], until: Callable[[Callable[[], bool]], None]
) -> None:
    name = make(queries=2)
    kept, lost = storage.queries.claim(name, "a", 2, 0.5)
    expires = storage.queries.renew(name, kept.id, kept.token, LONG)
    assert expires > kept.expires
    until(lambda: storage.queries.sweep_expired() == 1)
    assert storage.queries.get(name, kept.id).status == "leased"
    assert storage.queries.get(name, lost.id).status == "pending"
    with pytest.raises(LeaseExpired, match="claim a query again"):
        storage.queries.renew(name, lost.id, lost.token, LONG)


def test_a_query_that_fails_repeatedly_is_set_aside_with_its_error(storage: Storage, make: Callable[..., str]) -> None:
    name = make(queries=1)
    statuses = []
    for attempt in range(1, MAX_ATTEMPTS + 1):
        [leased] = storage.queries.claim(name, "a", 1, LONG)
        assert leased.attempt == attempt
        query = storage.queries.fail(name, leased.id, leased.token, f"fell over {attempt}")
        statuses.append(query.status)
    assert statuses == ["pending", "pending", "set_aside"]
    assert query.error == "fell over 3"
    assert storage.queries.claim(name, "a", 1, LONG) == []
    assert [event.body for event in storage.events.list(name) if event.kind == "set_aside"] == [
        {"query_id": leased.id, "error": "fell over 3"}
    ]
    assert storage.ledger.read(name) == LedgerRecord(unresolved=3, failed=3), "each may have moved the robot"


def test_a_query_whose_leases_expire_repeatedly_is_set_aside(
    storage: Storage, make: Callable[..., str], until: Callable[[Callable[[], bool]], None]
) -> None:
    name = make(queries=1)

    def gone() -> bool:
        storage.queries.claim(name, "hangs", 1, SHORT)
        return storage.surrogates.summary(name).queries.set_aside == 1

    until(gone)
    [query] = storage.queries.list(name, ["set_aside"])
    assert query.attempts == MAX_ATTEMPTS
    assert query.error is not None
    assert storage.ledger.read(name) == LedgerRecord(unresolved=MAX_ATTEMPTS, failed=0)


def test_resuming_a_surrogate_requeues_queries_that_were_set_aside(storage: Storage, make: Callable[..., str]) -> None:
    """With all attempts, of which giving back unbegun is none, and as often as somebody resumes."""
    name = make(queries=1)

    def fail(*, begun: bool = True) -> str:
        [leased] = storage.queries.claim(name, "a", 1, LONG)
        return storage.queries.fail(name, leased.id, leased.token, "no power", begun=begun).status

    for _ in range(2):
        assert [fail() for _ in range(MAX_ATTEMPTS)] == ["pending", "pending", "set_aside"]
        storage.surrogates.set_phase(name, "failed", "all were set aside")
        resumed = storage.surrogates.change(name, paused=False)
        assert (resumed.phase, resumed.error) == ("collecting", None)
        assert storage.designs.hopeless() == []
        assert fail(begun=False) == "pending"
    assert storage.surrogates.summary(name).queries.pending == 1
    told = [event.body for event in storage.events.list(name) if "asked_again" in event.body]
    assert [body["asked_again"] for body in told] == [1, 1]


def test_a_sample_for_a_failed_query_answers_it(
    storage: Storage, make: Callable[..., str], answer: Callable[..., NewSample]
) -> None:
    name = make(queries=1)
    [leased] = storage.queries.claim(name, "a", 1, LONG)
    storage.queries.fail(name, leased.id, leased.token, "the gripper slipped")
    assert storage.ledger.read(name) == LedgerRecord(unresolved=1, failed=1)
    storage.samples.add(name, "a", [answer(leased)])
    assert storage.ledger.read(name) == LedgerRecord(initial=1)


def test_a_query_returned_before_it_was_started_counts_as_no_attempt(
    storage: Storage, make: Callable[..., str], answer: Callable[..., NewSample]
) -> None:
    name = make(queries=1)
    for attempt in range(1, MAX_ATTEMPTS + 2):
        [leased] = storage.queries.claim(name, "a", 1, LONG)
        assert leased.attempt == attempt
        query = storage.queries.fail(name, leased.id, leased.token, "stopped", begun=False)
        assert storage.queries.fail(name, leased.id, leased.token, "stopped", begun=False) == query, "a repeat"
        assert query.status == "pending"
    with pytest.raises(LeaseExpired):
        storage.queries.fail(name, leased.id, leased.token, "fell over")
    assert storage.ledger.read(name) == LedgerRecord()
    for status in ("pending", "pending", "set_aside"):
        [again] = storage.queries.claim(name, "a", 1, LONG)
        assert storage.queries.fail(name, again.id, again.token, "fell over").status == status, "its attempts are left"
    storage.samples.add(name, "a", [answer(leased)])
    assert storage.ledger.read(name) == LedgerRecord(initial=1, unresolved=3, failed=3), "it was begun after all"


def test_a_query_refused_by_the_environment_costs_no_attempt_and_no_budget(
    storage: Storage, make: Callable[..., str]
) -> None:
    name = make(queries=1)
    left = storage.designs.left(name)
    [leased] = storage.queries.claim(name, "a", 1, LONG)
    query = storage.queries.fail(name, leased.id, leased.token, "it would overflow", begun=False, refused=True)
    assert (query.status, query.error) == ("refused", "it would overflow")
    again = storage.queries.fail(name, leased.id, leased.token, "it would overflow", begun=False, refused=True)
    assert again == query, "a repeat"
    assert storage.queries.claim(name, "a", 1, LONG) == []
    assert storage.ledger.read(name) == LedgerRecord()
    assert storage.surrogates.summary(name).queries == QueryCounts(refused=1)
    assert storage.surrogates.summary(name).queries == QueryCounts(refused=1)
    assert storage.designs.left(name) == left + 1
    assert storage.designs.hopeless() == [name], "none is left to ask"
    storage.surrogates.change(name, paused=False)
    assert storage.surrogates.summary(name).queries == QueryCounts(pending=1)


def test_a_failure_reported_twice_under_one_lease_counts_once(storage: Storage, make: Callable[..., str]) -> None:
    name = make(queries=1)
    [leased] = storage.queries.claim(name, "a", 1, LONG)
    first = storage.queries.fail(name, leased.id, leased.token, "x")
    assert storage.queries.fail(name, leased.id, leased.token, "x") == first
    [again] = storage.queries.claim(name, "b", 1, LONG)
    assert again.attempt == 2


def test_an_answered_query_can_no_longer_fail_or_be_renewed(
    storage: Storage, make: Callable[..., str], answer: Callable[..., NewSample]
) -> None:
    name = make(queries=1)
    [leased] = storage.queries.claim(name, "a", 1, LONG)
    storage.samples.add(name, "a", [answer(leased)])
    with pytest.raises(LeaseExpired):
        storage.queries.fail(name, leased.id, leased.token, "too late")
    with pytest.raises(LeaseExpired):
        storage.queries.renew(name, leased.id, leased.token, LONG)
    assert storage.queries.get(name, leased.id).status == "answered"


def test_a_wrong_lease_token_and_an_unknown_query_raise_different_errors(
    storage: Storage, make: Callable[..., str]
) -> None:
    name, other = make(name="one"), make(name="two")
    mine, neighbour = storage.queries.claim(name, "a", 2, LONG)
    [foreign] = storage.queries.claim(other, "a", 1, LONG)
    with pytest.raises(ForeignLease, match=f"query {mine.id}"):
        storage.queries.fail(name, mine.id, neighbour.token, "x")
    with pytest.raises(ForeignLease):
        storage.queries.renew(name, mine.id, "invented", LONG)
    with pytest.raises(UnknownQuery, match=str(foreign.id)):
        storage.queries.renew(name, foreign.id, foreign.token, LONG)
    with pytest.raises(UnknownQuery):
        storage.queries.get(name, foreign.id)


def test_manual_queries_sent_twice_with_one_idempotency_key_are_queued_once(
    storage: Storage, make: Callable[..., str]
) -> None:
    name = make(queries=0)
    asked, other = (steps(np.full((2, 2), value), np.ones((2, 1))) for value in (1.0, 2.0))
    ids = storage.queries.enqueue(name, asked, key="k")
    assert storage.queries.enqueue(name, asked, key="k") == ids
    with pytest.raises(IdempotencyConflict, match="'k'"):
        storage.queries.enqueue(name, other, key="k")
    assert [query.id for query in storage.queries.list(name)] == ids
    assert {query.purpose for query in storage.queries.list(name)} == {"manual"}
    assert storage.queries.enqueue(name, asked) != ids, "without a key it is another request"


def test_queries_are_listed_by_status(storage: Storage, make: Callable[..., str]) -> None:
    name = make(queries=3)
    [leased] = storage.queries.claim(name, "a", 1, LONG)
    assert [query.id for query in storage.queries.list(name, ["leased"])] == [leased.id]
    assert len(storage.queries.list(name, ["pending", "leased"])) == 3
    assert len(storage.queries.list(name, limit=2)) == 2
