"""The right to fit: one server at a time, and nothing half stored."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import sqlalchemy as sa

from support.queries import steps
from surrogym_server.errors import (
    BeyondBudget,
    IdempotencyConflict,
    LeaseExpired,
    NoModel,
    UnknownModel,
    UnknownSurrogate,
)
from surrogym_server.storage.records import FitLease, NewDesign, NewSample
from surrogym_server.storage.sql import Storage
from surrogym_server.storage.sql.queries import MAX_ATTEMPTS
from surrogym_shared.nouns import Query

LONG = 60.0
SHORT = 0.02
Wait = Callable[[Callable[[], bool]], None]


@pytest.fixture
def due(storage: Storage, make: Callable[..., str], answer_all: Callable[[str], None]) -> str:
    """A surrogate whose queries are all answered."""
    name = make(queries=3)
    answer_all(name)
    return name


def begun(storage: Storage, name: str, seconds: float = LONG) -> FitLease:
    lease = storage.designs.begin(name, "me", seconds)
    assert lease is not None
    return lease


def test_a_fit_is_due_when_no_query_is_open(
    storage: Storage, make: Callable[..., str], answer: Callable[..., NewSample]
) -> None:
    name = make(queries=2)
    assert storage.designs.due() == [], "nothing to learn from"
    first, second = storage.queries.claim(name, "a", 2, LONG)
    storage.samples.add(name, "a", [answer(first)])
    assert storage.designs.due() == [], "one is still leased"
    assert storage.designs.begin(name, "me", LONG) is None
    storage.samples.add(name, "a", [answer(second)])
    assert storage.designs.due() == [name]


def test_only_one_server_at_a_time_gets_the_fit_lease(storage: Storage, due: str) -> None:
    lease = begun(storage, due)
    assert storage.surrogates.get(due).phase == "fitting"
    assert storage.designs.begin(due, "another", LONG) is None
    assert storage.designs.due() == []
    assert storage.designs.renew(lease, 2 * LONG).expires > lease.expires


def test_the_fit_lease_of_a_dead_server_passes_to_another_server(
    storage: Storage, due: str, design: Callable[..., NewDesign], until: Wait
) -> None:
    dead = begun(storage, due, SHORT)
    until(lambda: storage.designs.due() == [due])
    heir = begun(storage, due)
    for late in (lambda: storage.designs.renew(dead, LONG), lambda: storage.designs.commit(dead, design())):
        with pytest.raises(LeaseExpired):
            late()
    storage.designs.abort(dead, "must not touch what another is fitting")
    assert storage.surrogates.get(due).phase == "fitting"
    assert storage.designs.commit(heir, design()) == 1


def test_a_fit_with_an_expired_lease_that_nobody_took_can_be_committed(
    storage: Storage, due: str, design: Callable[..., NewDesign], until: Wait
) -> None:
    lease = begun(storage, due, SHORT)
    until(lambda: storage.designs.due() == [due])
    assert storage.designs.commit(lease, design()) == 1


def test_committing_a_fit_stores_model_state_phase_and_queries_together(
    storage: Storage, due: str, design: Callable[..., NewDesign]
) -> None:
    storage.designs.commit(begun(storage, due), design(queries=2, state={"keys": [1, 2]}))
    record = storage.surrogates.get(due)
    assert (record.phase, record.round, record.state, record.error) == ("sampling", 1, {"keys": [1, 2]}, None)
    pending = storage.queries.list(due, ["pending"])
    assert [(query.purpose, query.round) for query in pending] == 2 * [("adaptive", 1)]
    assert storage.models.blob(due) == b"\0model"
    assert storage.designs.due() == []


def test_design_rounds_continue_until_there_are_no_more_queries(
    storage: Storage, due: str, design: Callable[..., NewDesign], answer_all: Callable[[str], None]
) -> None:
    assert storage.designs.commit(begun(storage, due), design(queries=1)) == 1
    answer_all(due)
    assert storage.designs.commit(begun(storage, due), design(phase="ready")) == 2
    assert storage.designs.due() == []
    assert storage.surrogates.get(due).round == 2
    assert (storage.ledger.read(due).initial, storage.ledger.read(due).adaptive) == (3, 1)


def test_samples_added_during_a_fit_make_the_next_fit_due(
    storage: Storage, due: str, design: Callable[..., NewDesign], by_hand: Callable[..., NewSample]
) -> None:
    lease = begun(storage, due)
    storage.samples.add(due, "a", [by_hand()])
    storage.designs.commit(lease, design(phase="ready"))
    assert storage.designs.due() == [due]


def test_a_failed_fit_is_due_again_only_after_a_new_sample(
    storage: Storage, due: str, by_hand: Callable[..., NewSample]
) -> None:
    storage.designs.abort(begun(storage, due), "singular")
    record = storage.surrogates.get(due)
    assert (record.phase, record.error) == ("failed", "singular")
    assert storage.designs.due() == []
    storage.samples.add(due, "a", [by_hand()])
    assert storage.designs.due() == [due]


def test_a_failed_fit_is_tried_again_when_resumed(storage: Storage, due: str) -> None:
    storage.designs.abort(begun(storage, due), "singular")
    storage.surrogates.change(due, paused=False)
    assert storage.designs.due() == [due]


def test_a_fit_aborted_at_shutdown_stays_due(storage: Storage, due: str) -> None:
    lease = begun(storage, due)
    storage.designs.abort(lease, None)
    storage.designs.abort(lease, None)
    assert storage.surrogates.get(due).phase == "collecting"
    assert storage.designs.due() == [due]


@pytest.mark.parametrize("change", [{"budget": 60}, {"target": 0.9}])
def test_a_changed_budget_or_target_makes_a_finished_design_due(
    storage: Storage, due: str, design: Callable[..., NewDesign], change: dict[str, float]
) -> None:
    storage.designs.commit(begun(storage, due), design(phase="over_budget"))
    storage.surrogates.change(due, paused=False)
    assert storage.designs.due() == [], "resuming what was not paused is nothing new"
    storage.surrogates.change(due, **change)  # type: ignore[arg-type]
    assert storage.designs.due() == [due]


ASKED_ANEW = ({"tolerances": {"theta": 0.5}}, {"target": 0.9}, {"budget": 3})


@pytest.mark.parametrize("change", ASKED_ANEW)
def test_changing_the_target_withdraws_queries_that_no_sampler_has_started(
    storage: Storage, due: str, design: Callable[..., NewDesign], change: dict[str, Any]
) -> None:
    """A tolerance typed wrong costs no real step; a step that may have been taken stays in the ledger."""
    storage.designs.commit(begun(storage, due), design(queries=3))
    lost, behind = storage.queries.claim(due, "a", 2, LONG)
    storage.queries.fail(due, lost.id, lost.token, "unreachable")
    storage.queries.fail(due, behind.id, behind.token, "the sampler was stopped", begun=False)
    by_hand = storage.queries.enqueue(due, steps([[1.0, 1.0]], [[1.0]]))
    storage.surrogates.change(due, budget=60)
    assert len(storage.queries.list(due, ("pending",))) == 4, "more room is no reason to choose anew"
    storage.surrogates.change(due, **change)
    assert [query.id for query in storage.queries.list(due, ("pending",))] == [lost.id, *by_hand]
    assert storage.ledger.read(due).unresolved == 1


@pytest.mark.parametrize(("change", "again"), [({"tolerances": {"theta": 0.5}}, 2), ({"budget": 7}, 0)])
def test_the_design_chooses_new_queries_for_withdrawn_extra_ones_unless_the_budget_shrank(
    storage: Storage, due: str, design: Callable[..., NewDesign], change: dict[str, Any], again: int
) -> None:
    storage.designs.commit(begun(storage, due), design(phase="ready"))
    storage.designs.improve(due, 3)
    storage.designs.commit(begun(storage, due), replace(design(queries=3), extra=True))
    assert storage.surrogates.get(due).extra_queries == 0
    storage.queries.claim(due, "a", 1, LONG)
    assert storage.surrogates.change(due, **change).extra_queries == again


def test_lowering_the_budget_withdraws_the_initial_queries_beyond_it(
    storage: Storage, make: Callable[..., str], answer_all: Callable[[str], None]
) -> None:
    name = make(queries=6)
    first = [query.id for query in storage.queries.list(name)][:4]
    storage.queries.claim(name, "a", 1, LONG)
    storage.surrogates.change(name, tolerances={"theta": 0.5})
    assert len(storage.queries.list(name)) == 6
    storage.surrogates.change(name, budget=4)
    assert [query.id for query in storage.queries.list(name)] == first


def test_a_changed_tolerance_makes_a_fit_due_despite_unleased_queries(
    storage: Storage, due: str, design: Callable[..., NewDesign]
) -> None:
    storage.designs.commit(begun(storage, due), design(queries=2))
    storage.surrogates.change(due, tolerances={"theta": 0.5})
    assert storage.designs.due() == [due]


@pytest.mark.parametrize("change", ASKED_ANEW)
def test_a_fit_is_repeated_if_the_settings_changed_meanwhile(
    storage: Storage, due: str, design: Callable[..., NewDesign], change: dict[str, Any]
) -> None:
    lease = begun(storage, due)
    assert storage.surrogates.change(due, **change).phase == "collecting"
    with pytest.raises(LeaseExpired):
        storage.designs.commit(lease, design(queries=3))
    assert storage.designs.due() == [due]
    assert storage.queries.list(due, ("pending",)) == []


def test_a_paused_design_is_not_fitted(storage: Storage, due: str) -> None:
    storage.surrogates.change(due, paused=True)
    assert storage.designs.due() == []
    assert storage.designs.begin(due, "me", LONG) is None


def test_a_fit_is_due_although_some_queries_were_set_aside(
    storage: Storage, due: str, design: Callable[..., NewDesign]
) -> None:
    storage.designs.commit(begun(storage, due), design(queries=1))
    for _ in range(MAX_ATTEMPTS):
        [leased] = storage.queries.claim(due, "a", 1, LONG)
        storage.queries.fail(due, leased.id, leased.token, "unreachable")
    assert storage.designs.due() == [due]


def test_a_repeated_improve_request_raises_the_budget_and_reaches_the_next_fit_once(
    storage: Storage, due: str, design: Callable[..., NewDesign]
) -> None:
    storage.surrogates.change(due, budget=4)
    storage.designs.commit(begun(storage, due), design(phase="ready"))
    for _ in range(2):
        granted = storage.designs.improve(due, 5, checkpoint="half-way", key="k", raise_budget=True)
        record = granted.record
        assert (record.extra_queries, record.budget, record.checkpoint) == (5, 8, "half-way")
        assert granted.raised == 4, "a repeat says what the first said"
    with pytest.raises(IdempotencyConflict):
        storage.designs.improve(due, 6, checkpoint="half-way", key="k")
    lease = begun(storage, due)
    assert (lease.extra_queries, lease.checkpoint) == (5, "half-way")
    storage.designs.improve(due, 2, raise_budget=True)
    storage.designs.commit(lease, design(queries=5))
    assert storage.surrogates.get(due).extra_queries == 2, "asked for after the fit began"


def test_a_trial_is_asked_at_once_within_the_budget_and_only_once(storage: Storage, due: str) -> None:
    trial = Query.rollout([[0.5], [0.25]], policy=b"arrays")
    before = storage.surrogates.get(due)
    for _ in range(2):
        granted = storage.designs.improve(due, trial, key="k", raise_budget=True)
        assert (granted.record.extra_queries, granted.record.phase) == (before.extra_queries, "collecting")
        assert granted.record.budget == before.budget + granted.raised
    for other in (replace(trial, policy=b"others"), replace(trial, actions=((0.5,), (0.75,)))):
        with pytest.raises(IdempotencyConflict):
            storage.designs.improve(due, other, key="k")
    pending = storage.queries.list(due, ("pending",))
    assert [(query.policy, query.actions, query.purpose) for query in pending] == [
        (b"arrays", trial.actions, "adaptive")
    ]
    (leased,) = storage.queries.claim(due, "a", 9, LONG)
    assert leased.policy == b"arrays"
    assert storage.designs.due() == [], "the fit waits for the trial"


def test_an_improve_request_does_not_raise_a_budget_that_is_large_enough(storage: Storage, due: str) -> None:
    granted = storage.designs.improve(due, 5, raise_budget=True)
    assert (granted.record.budget, granted.raised) == (30, 0)


def test_an_improve_request_without_budget_rights_gets_at_most_the_remaining_steps(storage: Storage, due: str) -> None:
    """The budget is the owner's: steps taken, queries open or set aside, and what was promised before all count."""
    storage.queries.enqueue(due, steps(np.zeros((2, 2)), np.zeros((2, 1))))
    for _ in range(MAX_ATTEMPTS):
        [leased] = storage.queries.claim(due, "a", 1, LONG)
        storage.queries.fail(due, leased.id, leased.token, "unreachable")
    storage.surrogates.change(due, budget=10)
    assert storage.designs.left(due) == 10 - 3 - 2
    storage.designs.improve(due, 4)
    assert storage.designs.left(due) == 1
    with pytest.raises(BeyondBudget, match=r"at most 1 more real steps.*10 real steps.*got 2.*--budget 11"):
        storage.designs.improve(due, 2)
    assert (storage.designs.left(due), storage.surrogates.get(due).extra_queries) == (1, 4), "nothing was changed"
    storage.designs.improve(due, 1)
    storage.surrogates.change(due, budget=3)
    assert storage.designs.left(due) == 0


def test_simultaneous_improve_requests_get_at_most_the_remaining_budget(storage: Storage, due: str) -> None:
    def ask(_: int) -> int:
        try:
            return storage.designs.improve(due, 4).record.extra_queries
        except BeyondBudget:
            return 0

    with ThreadPoolExecutor(8) as threads:
        granted = [extra for extra in threads.map(ask, range(16)) if extra]
    assert sorted(granted) == [4, 8, 12, 16, 20, 24], "27 of 30 were left"


def test_committing_a_fit_of_a_deleted_surrogate_is_refused(
    storage: Storage, due: str, design: Callable[..., NewDesign], make: Callable[..., str]
) -> None:
    lease = begun(storage, due)
    storage.surrogates.delete(due)
    with pytest.raises(UnknownSurrogate):
        storage.designs.commit(lease, design())
    storage.designs.abort(lease, None)
    make(name=due)
    with pytest.raises(LeaseExpired):
        storage.designs.commit(lease, design())


def test_a_failed_commit_of_a_fit_stores_nothing(storage: Storage, due: str, design: Callable[..., NewDesign]) -> None:
    lease = begun(storage, due)
    whole = design(queries=2)
    wrong = (Query.step((1.0, 1.0), ("no number",)),)  # type: ignore[arg-type]
    with pytest.raises(sa.exc.StatementError, match="no number"):
        storage.designs.commit(lease, design(queries=wrong))
    assert storage.models.list(due) == []
    assert storage.surrogates.get(due).round == 0
    assert storage.designs.commit(lease, whole) == 1


def test_model_versions_start_at_one_in_each_surrogate(
    storage: Storage, make: Callable[..., str], design: Callable[..., NewDesign]
) -> None:
    one, two = make(name="one"), make(name="two")
    model = design().model
    with pytest.raises(NoModel):
        storage.models.get(one)
    assert [storage.models.add(name, model) for name in (one, one, two)] == [1, 2, 1]
    assert [record.version for record in storage.models.list(one)] == [1, 2]
    assert storage.models.get(one).version == 2
    assert storage.models.get(one, 1).fidelity == model.fidelity
    assert storage.models.blob(one, 1) == model.blob
    with pytest.raises(UnknownModel, match="3"):
        storage.models.get(one, 3)
    with pytest.raises(UnknownModel):
        storage.models.blob(two, 2)
