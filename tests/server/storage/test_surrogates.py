"""Surrogates by name: created once, changed by hand, deleted whole."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from surrogym_server.errors import UnknownSurrogate
from surrogym_server.storage.port import Storage
from surrogym_server.storage.records import NewDesign, NewSurrogate


def test_a_new_surrogate_is_collecting_with_its_initial_queries(storage: Storage, make: Callable[..., str]) -> None:
    name = make(queries=3)
    record = storage.surrogates.get(name)
    assert (record.phase, record.paused, record.round, record.error) == ("collecting", False, 0, None)
    assert (record.budget, record.target, record.state) == (30, 0.999, {"round": 0})
    first, *_, last = storage.queries.list(name)
    assert (first.purpose, first.status, first.round) == ("initial", "pending", 0)
    assert (first.coordinates, last.coordinates, last.action) == ((0.0, 1.0), (4.0, 5.0), (0.5,))


def test_creating_again_with_the_same_spec_changes_nothing(storage: Storage) -> None:
    new = NewSurrogate("a", {"x": [1, 2.5], "y": None}, 30, 0.9)
    first, created = storage.surrogates.create(new)
    assert created
    repeat = NewSurrogate("a", {"y": None, "x": [1, 2.5]}, 99, 0.5, {}, np.ones((4, 2)), np.ones((4, 1)))
    assert storage.surrogates.create(repeat) == (first, False)
    assert storage.queries.counts("a").pending == 0


def test_a_name_that_is_taken_keeps_its_spec(storage: Storage) -> None:
    first, _ = storage.surrogates.create(NewSurrogate("a", {"x": 1}, 30, 0.9))
    assert storage.surrogates.create(NewSurrogate("a", {"x": 2}, 30, 0.9)) == (first, False)
    assert storage.surrogates.get("a").spec == {"x": 1}


def test_a_name_given_anew_is_another_surrogate(
    storage: Storage, make: Callable[..., str], answer_all: Callable[[str], None], design: Callable[..., NewDesign]
) -> None:
    name = make()
    before = storage.surrogates.get(name).id
    assert (storage.surrogates.name_of(before), storage.models.newest()) == (name, {})
    answer_all(name)
    lease = storage.designs.begin(name, "server", 60.0)
    assert lease is not None
    storage.designs.commit(lease, design())
    assert storage.models.newest() == {before: 1}
    storage.surrogates.delete(name)
    assert storage.models.newest() == {}
    with pytest.raises(UnknownSurrogate):
        storage.surrogates.name_of(before)
    make()
    assert storage.surrogates.get(name).id > before


def test_surrogates_are_listed_in_order_of_creation(storage: Storage, make: Callable[..., str]) -> None:
    for name in ("b", "a", "c"):
        make(name=name)
    assert [summary.name for summary in storage.surrogates.summaries()] == ["b", "a", "c"]


def test_change_touches_what_is_given_and_no_more(storage: Storage, make: Callable[..., str]) -> None:
    name = make()
    before = storage.surrogates.get(name)
    after = storage.surrogates.change(name, budget=50)
    assert (after.budget, after.target, after.paused) == (50, before.target, False)
    assert storage.surrogates.change(name, paused=True).paused
    assert not storage.surrogates.change(name, paused=False).paused


def test_tolerances_are_set_one_by_one(storage: Storage, make: Callable[..., str]) -> None:
    name = make()
    assert storage.surrogates.get(name).tolerances == {}
    storage.surrogates.change(name, tolerances={"theta": 0.1, "reward": 2.0})
    storage.surrogates.change(name, tolerances={"theta": 0.01})
    assert storage.surrogates.get(name).tolerances == {"theta": 0.01, "reward": 2.0}
    storage.surrogates.change(name, tolerances={"reward": None, "theta_dot": None})
    assert storage.surrogates.get(name).tolerances == {"theta": 0.01}


def test_set_phase_keeps_the_error(storage: Storage, make: Callable[..., str]) -> None:
    name = make()
    storage.surrogates.set_phase(name, "failed", "it broke")
    record = storage.surrogates.get(name)
    assert (record.phase, record.error) == ("failed", "it broke")


def test_resuming_a_failed_design_clears_its_error(storage: Storage, make: Callable[..., str]) -> None:
    name = make()
    storage.surrogates.set_phase(name, "failed", "it broke")
    record = storage.surrogates.change(name, paused=False)
    assert (record.phase, record.error) == ("collecting", None)


def test_deleting_takes_everything_and_frees_the_name(
    storage: Storage, make: Callable[..., str], answer_all: Callable[[str], None]
) -> None:
    name = make()
    answer_all(name)
    old = [query.id for query in storage.queries.list(name)]
    storage.surrogates.delete(name)
    make(name=name)
    assert storage.samples.count(name) == 0
    assert not set(old) & {query.id for query in storage.queries.list(name)}, "ids are never used twice"


def test_every_operation_refuses_an_unknown_surrogate(storage: Storage, by_hand: Callable[..., object]) -> None:
    none = np.zeros((0, 2))
    operations: list[Callable[[], object]] = [
        lambda: storage.surrogates.get("no"),
        lambda: storage.surrogates.summary("no"),
        lambda: storage.surrogates.change("no", paused=True),
        lambda: storage.surrogates.set_phase("no", "ready"),
        lambda: storage.surrogates.delete("no"),
        lambda: storage.designs.improve("no", 1),
        lambda: storage.designs.begin("no", "me", 1),
        lambda: storage.queries.enqueue("no", none, none),
        lambda: storage.queries.claim("no", "w", 1, 1),
        lambda: storage.queries.renew("no", 1, "t", 1),
        lambda: storage.queries.fail("no", 1, "t", "e"),
        lambda: storage.queries.get("no", 1),
        lambda: storage.queries.list("no"),
        lambda: storage.queries.counts("no"),
        lambda: storage.samples.add("no", "w", [by_hand()]),  # type: ignore[list-item]
        lambda: storage.samples.arrays("no"),
        lambda: storage.samples.page("no", 0, 1),
        lambda: storage.samples.count("no"),
        lambda: storage.ledger.report("no", 1, key="k"),
        lambda: storage.ledger.read("no"),
        lambda: storage.models.list("no"),
        lambda: storage.models.get("no"),
        lambda: storage.models.blob("no"),
        lambda: storage.models.set_aside("no", 1, "d"),
        lambda: storage.occupancy.put("no", "c", none),
        lambda: storage.occupancy.latest("no"),
        lambda: storage.events.list("no"),
    ]
    for operation in operations:
        with pytest.raises(UnknownSurrogate, match="'no'"):
            operation()
