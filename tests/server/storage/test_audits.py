"""Audit queries: apart from the budget, bounded, and taken back while nobody has begun them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from support.queries import steps
from surrogym_server.errors import BeyondBudget
from surrogym_server.storage.records import NewSample
from surrogym_server.storage.sql import Storage
from surrogym_shared.nouns import Query
from surrogym_shared.states import LEAST_AUDITED

Make = Callable[..., str]
FOUR = steps(np.zeros((4, 2)), np.zeros((4, 1)))


def test_audit_queries_cost_no_budget(storage: Storage, make: Make, answer: Callable[..., NewSample]) -> None:
    name = make(queries=0, budget=3)
    storage.queries.enqueue(name, FOUR, purpose="audit")
    assert storage.designs.left(name) == 3
    leased = storage.queries.claim(name, "a", 4, 60.0)
    storage.samples.add(name, "a", [answer(query) for query in leased])
    ledger = storage.ledger.read(name)
    assert (ledger.audit, ledger.total, ledger.samples) == (4, 0, 4)
    assert storage.designs.left(name) == 3
    assert set(storage.samples.arrays(name).purpose) == {"audit"}
    assert storage.designs.due() == [name], "the model learns from them"


def test_audit_queries_beyond_their_total_limit_are_refused(storage: Storage, make: Make) -> None:
    name = make(queries=0, budget=3)
    many = steps(np.zeros((LEAST_AUDITED, 2)), np.zeros((LEAST_AUDITED, 1)))
    ids = storage.queries.enqueue(name, many, purpose="audit", key="k")
    assert storage.queries.enqueue(name, many, purpose="audit", key="k") == ids, "the same again asks for nothing"
    with pytest.raises(BeyondBudget, match="at most 0 more real steps of audits, got 4"):
        storage.queries.enqueue(name, FOUR, purpose="audit")
    assert storage.surrogates.summary(name).queries.pending == LEAST_AUDITED
    storage.queries.enqueue(name, FOUR)


def test_the_reward_range_of_a_surrogate_covers_all_its_samples(
    storage: Storage, make: Make, by_hand: Callable[..., NewSample]
) -> None:
    name = make(queries=0)
    assert storage.samples.reward_range(name) is None
    storage.samples.add(name, "a", [by_hand(reward=reward) for reward in (2.0, -1.5, 0.0)], key="k")
    assert storage.samples.reward_range(name) == (-1.5, 2.0)


def test_steps_that_an_audits_rollout_did_not_take_are_left_for_other_audits(
    storage: Storage, make: Make, answer: Callable[..., NewSample]
) -> None:
    """A rollout that ended early counted with all its expected steps, unlike in the ledger."""
    name = make(queries=0, budget=3)
    storage.queries.enqueue(name, [Query.rollout([[0.0]] * (LEAST_AUDITED - 4))], purpose="audit")
    [query] = storage.queries.claim(name, "a", 1, 60.0)
    with pytest.raises(BeyondBudget, match="at most 4 more"):
        storage.queries.enqueue(name, [Query.rollout([[0.0]] * 5)], purpose="audit")
    storage.samples.add(name, "a", [answer(query, step=step, terminated=step == 1) for step in range(2)])
    assert storage.ledger.read(name).audit == 2
    with pytest.raises(BeyondBudget, match=f"at most {LEAST_AUDITED - 2} more"):
        storage.queries.enqueue(name, [Query.rollout([[0.0]] * (LEAST_AUDITED - 1))], purpose="audit")
    storage.queries.enqueue(name, [Query.rollout([[0.0]] * (LEAST_AUDITED - 2))], purpose="audit")


def test_resuming_a_surrogate_does_not_repeat_the_failed_queries_of_an_audit(
    storage: Storage, make: Callable[..., str]
) -> None:
    """Real steps were taken for an audit that had ended."""
    name = make(queries=1)
    [own] = storage.queries.claim(name, "a", 1, 60.0)
    storage.queries.enqueue(name, FOUR[:1], purpose="audit")
    [audited] = storage.queries.claim(name, "a", 1, 60.0)
    for leased in (own, audited):
        storage.queries.fail(name, leased.id, leased.token, "not there", begun=True, refused=True)
    storage.surrogates.change(name, paused=False)
    assert [storage.queries.get(name, query.id).status for query in (own, audited)] == ["pending", "refused"]
