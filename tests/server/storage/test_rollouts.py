"""Rollouts: an action sequence is one query, its answer any number of samples, and every one of them is counted."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from surrogym_server.errors import IdempotencyConflict, InvalidInput
from surrogym_server.storage.records import LeasedQuery, LedgerRecord, NewDesign, NewSample, QueryCounts
from surrogym_server.storage.sql import Storage
from surrogym_shared.nouns import Query

LONG = 60.0
SHORT = 0.02
ROLLOUTS = (Query.rollout([[0.5], [-0.5], [1 / 3]]), Query.rollout([[2.0]]))  # of three steps and of one
Wait = Callable[[Callable[[], bool]], None]
Answer = Callable[..., NewSample]


@pytest.fixture
def name(make: Callable[..., str]) -> str:
    return make(queries=ROLLOUTS)


@pytest.fixture
def long(storage: Storage, name: str) -> LeasedQuery:
    return storage.queries.claim(name, "a", 1, LONG)[0]


def test_the_actions_of_a_rollout_query_are_stored_bit_exactly(storage: Storage, name: str) -> None:
    long, short = storage.queries.claim(name, "a", 2, LONG)
    assert [(q.kind, q.coordinates, q.steps) for q in (long, short)] == [("rollout", (), 3), ("rollout", (), 1)]
    assert [q.actions for q in (long, short)] == [q.actions for q in ROLLOUTS]
    assert storage.queries.get(name, long.id).actions == ROLLOUTS[0].actions


def test_a_claimed_rollout_says_whether_its_actions_are_planned_anew(
    storage: Storage, make: Callable[..., str]
) -> None:
    name = make(queries=(Query.rollout([[0.5], [0.25]], replan=True), ROLLOUTS[1]))
    assert [query.replan for query in storage.queries.claim(name, "a", 2, LONG)] == [True, False]
    assert [query.replan for query in storage.queries.list(name)] == [True, False]


def test_manual_step_and_rollout_queries_can_be_queued_together(storage: Storage, make: Callable[..., str]) -> None:
    name = make(queries=0)
    by_hand = Query.step((1.0, 1.0), (1.0,))
    step, rollout = storage.queries.enqueue(name, [by_hand, ROLLOUTS[0]], key="k")
    assert storage.queries.enqueue(name, [by_hand, ROLLOUTS[0]], key="k") == [step, rollout]
    assert [q.kind for q in storage.queries.list(name)] == ["step", "rollout"]
    with pytest.raises(IdempotencyConflict):
        storage.queries.enqueue(name, [by_hand, ROLLOUTS[1]], key="k")


def test_every_step_of_a_rollout_is_a_sample_of_one_trajectory(
    storage: Storage, name: str, long: LeasedQuery, answer: Answer
) -> None:
    added = storage.samples.add(name, "a", [answer(long, step=i, reward=float(i)) for i in range(3)])
    samples = storage.samples.page(name, 0, 10)
    assert [(s.id, s.query_id, s.step, s.reward) for s in samples] == [
        (id, long.id, i, float(i)) for i, id in enumerate(added.ids)
    ]
    assert len({s.trajectory for s in samples}) == 1
    assert samples[0].trajectory is not None
    assert samples[0].requested_coordinates is None
    assert storage.surrogates.summary(name).queries == QueryCounts(pending=1, answered=1)
    assert storage.ledger.read(name) == LedgerRecord(initial=3, resets=1)


def test_the_ledger_counts_resets_and_steps_at_a_bound_of_the_action_once(
    storage: Storage, make: Callable[..., str], answer: Answer
) -> None:
    of_each = (ROLLOUTS[0], Query.rollout([[0.5]], snapshot="s"), Query.step((1.0, 1.0), (1.0,)), ROLLOUTS[1])
    name = make(queries=of_each)
    long, *others = storage.queries.claim(name, "a", 4, LONG)
    batch = [answer(long, step=i) for i in range(3)]
    for _ in range(2):
        storage.samples.add(name, "a", batch, at_bound=[True, False, True])
        assert storage.ledger.read(name) == LedgerRecord(initial=3, resets=1, wear=2)
    storage.samples.add(name, "a", [answer(query) for query in others], at_bound=[False, True, False])
    assert storage.ledger.read(name) == LedgerRecord(initial=6, resets=2, wear=3)
    assert storage.surrogates.summaries()[0].ledger == storage.ledger.read(name)


def test_the_sample_of_a_step_query_belongs_to_no_trajectory(
    storage: Storage, make: Callable[..., str], answer: Answer
) -> None:
    [query] = storage.queries.claim(make(queries=1), "a", 1, LONG)
    storage.samples.add("pendulum", "a", [answer(query)])
    [sample] = storage.samples.page("pendulum", 0, 1)
    assert (sample.trajectory, sample.step) == (None, 0)


def test_a_rollout_that_terminates_early_returns_its_unused_steps_to_the_budget(
    storage: Storage, name: str, long: LeasedQuery, answer: Answer
) -> None:
    raised = storage.designs.improve(name, 30, raise_budget=True).record.budget
    assert raised == 3 + 1 + 30, "open rollouts are spoken for with all their steps"
    storage.samples.add(name, "a", [answer(long, step=0), answer(long, step=1, terminated=True)])
    assert storage.queries.get(name, long.id).status == "answered"
    raised = storage.designs.improve(name, 1, raise_budget=True).record.budget
    assert raised == 34, "2 taken, 1 open, 31 asked for: the third step is free again"
    assert storage.ledger.read(name).total == 2


def test_rollout_samples_sent_twice_are_stored_once_and_changed_ones_refused(
    storage: Storage, name: str, long: LeasedQuery, answer: Answer
) -> None:
    batch = [answer(long, step=0), answer(long, step=1)]
    first = storage.samples.add(name, "a", batch)
    again = storage.samples.add(name, "a", batch)
    assert (again.ids, again.duplicates) == (first.ids, 2)
    with pytest.raises(IdempotencyConflict, match="2 samples first reported"):
        storage.samples.add(name, "a", [*batch, answer(long, step=2)])
    with pytest.raises(IdempotencyConflict, match="got another"):
        storage.samples.add(name, "a", [batch[0], answer(long, step=1, reward=7.0)])
    assert storage.samples.count(name) == 2


@pytest.mark.parametrize("steps", [(1,), (0, 2), (0, 1, 2, 3)], ids=["no start", "a gap", "too many"])
def test_rollout_samples_with_missing_or_too_many_steps_are_refused(
    storage: Storage, name: str, long: LeasedQuery, answer: Answer, steps: tuple[int, ...]
) -> None:
    batch = [answer(long, reward=float(i)) for i in steps]
    batch = [NewSample(**vars(sample) | {"step": i}) for sample, i in zip(batch, steps, strict=True)]
    with pytest.raises(InvalidInput, match=rf"steps 0, 1, ... of query {long.id}, at most 3"):
        storage.samples.add(name, "a", batch)
    assert storage.samples.count(name) == 0
    assert storage.queries.get(name, long.id).status == "leased"


def test_all_steps_of_a_rollout_count_as_unresolved_if_its_sampler_dies(
    storage: Storage, name: str, answer: Answer, until: Wait
) -> None:
    [lost] = storage.queries.claim(name, "dead", 1, SHORT)
    until(lambda: storage.ledger.read(name).unresolved == 3)
    [again] = storage.queries.claim(name, "next", 1, LONG)
    assert (again.id, again.attempt) == (lost.id, 2)
    storage.samples.add(name, "next", [answer(again, step=0)])
    assert storage.ledger.read(name) == LedgerRecord(initial=1, unresolved=3, resets=1)
    storage.samples.add(name, "dead", [answer(lost, step=0), answer(lost, step=1)])
    assert storage.ledger.read(name) == LedgerRecord(initial=3, resets=2), (
        "it was not dead, and its two steps are true ones"
    )
    first, *late = storage.samples.page(name, 0, 10)
    assert [(s.late, s.step) for s in late] == [(True, 0), (True, 1)]
    assert {s.trajectory for s in late} != {first.trajectory}


def test_rollout_queries_that_a_design_chose_are_handed_out_with_purpose_adaptive(
    storage: Storage, name: str, answer: Answer, design: Callable[..., NewDesign]
) -> None:
    for query in storage.queries.claim(name, "a", 2, LONG):
        storage.samples.add(name, "a", [answer(query)])
    lease = storage.designs.begin(name, "server", LONG)
    assert lease is not None
    storage.designs.commit(lease, design(queries=ROLLOUTS[:1]))
    [query] = storage.queries.claim(name, "a", 5, LONG)
    assert (query.purpose, query.actions) == ("adaptive", ROLLOUTS[0].actions)
