"""Surrogates by name: created once, changed by hand, deleted whole."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import ModuleType

import numpy as np
import pytest
import sqlalchemy as sa

from support.queries import steps
from surrogym_server.errors import UnknownSurrogate
from surrogym_server.storage.records import NewDesign, NewSurrogate
from surrogym_server.storage.sql import Storage, designs, queries
from surrogym_server.storage.sql import surrogates as stored
from surrogym_server.storage.sql.tables import metadata, surrogates

NAME = "pendulum"


def test_a_new_surrogate_is_in_phase_collecting_with_its_initial_queries(
    storage: Storage, make: Callable[..., str]
) -> None:
    name = make(queries=3)
    record = storage.surrogates.get(name)
    assert (record.phase, record.paused, record.round, record.error) == ("collecting", False, 0, None)
    assert (record.budget, record.target, record.state) == (30, 0.999, {})
    first, *_, last = storage.queries.list(name)
    assert (first.purpose, first.status, first.round) == ("initial", "pending", 0)
    assert (first.coordinates, last.coordinates, last.action) == ((0.0, 1.0), (4.0, 5.0), (0.5,))


def test_creating_a_surrogate_again_with_the_same_specification_changes_nothing(storage: Storage) -> None:
    new = NewSurrogate("a", {"x": [1, 2.5], "y": None}, 30, 0.9)
    first, created = storage.surrogates.create(new)
    assert created
    repeat = NewSurrogate("a", {"y": None, "x": [1, 2.5]}, 99, 0.5, steps(np.ones((4, 2)), np.ones((4, 1))))
    assert storage.surrogates.create(repeat) == (first, False)
    assert storage.surrogates.summary("a").queries.pending == 0


def test_creating_a_surrogate_under_an_existing_name_keeps_its_specification(storage: Storage) -> None:
    first, _ = storage.surrogates.create(NewSurrogate("a", {"x": 1}, 30, 0.9))
    assert storage.surrogates.create(NewSurrogate("a", {"x": 2}, 30, 0.9)) == (first, False)
    assert storage.surrogates.get("a").spec == {"x": 1}


def test_a_surrogate_recreated_under_a_deleted_name_gets_a_new_id(
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


def test_changing_a_surrogate_changes_only_the_given_fields(storage: Storage, make: Callable[..., str]) -> None:
    name = make()
    before = storage.surrogates.get(name)
    after = storage.surrogates.change(name, budget=50)
    assert (after.budget, after.target, after.paused) == (50, before.target, False)
    assert storage.surrogates.change(name, paused=True).paused
    assert not storage.surrogates.change(name, paused=False).paused


def test_tolerances_of_a_surrogate_can_be_set_one_by_one(storage: Storage, make: Callable[..., str]) -> None:
    name = make()
    assert storage.surrogates.get(name).tolerances == {}
    storage.surrogates.change(name, tolerances={"theta": 0.1, "reward": 2.0})
    storage.surrogates.change(name, tolerances={"theta": 0.01})
    assert storage.surrogates.get(name).tolerances == {"theta": 0.01, "reward": 2.0}
    storage.surrogates.change(name, tolerances={"reward": None, "theta_dot": None})
    assert storage.surrogates.get(name).tolerances == {"theta": 0.01}


def test_setting_phase_failed_stores_its_error(storage: Storage, make: Callable[..., str]) -> None:
    name = make()
    storage.surrogates.set_phase(name, "failed", "it broke")
    record = storage.surrogates.get(name)
    assert (record.phase, record.error) == ("failed", "it broke")


def test_resuming_a_failed_design_clears_its_error(storage: Storage, make: Callable[..., str]) -> None:
    name = make()
    storage.surrogates.set_phase(name, "failed", "it broke")
    record = storage.surrogates.change(name, paused=False)
    assert (record.phase, record.error) == ("collecting", None)


def test_deleting_a_surrogate_deletes_everything_and_frees_its_name(
    storage: Storage, make: Callable[..., str], answer_all: Callable[[str], None]
) -> None:
    name = make()
    answer_all(name)
    old = [query.id for query in storage.queries.list(name)]
    storage.surrogates.delete(name)
    make(name=name)
    assert storage.samples.count(name) == 0
    assert not set(old) & {query.id for query in storage.queries.list(name)}, "ids are never used twice"


def test_every_storage_operation_refuses_an_unknown_surrogate(storage: Storage, by_hand: Callable[..., object]) -> None:
    none = np.zeros((0, 2))
    operations: list[Callable[[], object]] = [
        lambda: storage.surrogates.get("no"),
        lambda: storage.surrogates.summary("no"),
        lambda: storage.surrogates.change("no", paused=True),
        lambda: storage.surrogates.set_phase("no", "ready"),
        lambda: storage.surrogates.delete("no"),
        lambda: storage.designs.improve("no", 1),
        lambda: storage.designs.begin("no", "me", 1),
        lambda: storage.queries.enqueue("no", ()),
        lambda: storage.queries.claim("no", "w", 1, 1),
        lambda: storage.queries.renew("no", 1, "t", 1),
        lambda: storage.queries.fail("no", 1, "t", "e"),
        lambda: storage.queries.get("no", 1),
        lambda: storage.queries.list("no"),
        lambda: storage.surrogates.summary("no").queries,
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


def test_many_initial_queries_are_stored_in_limited_transactions_even_after_a_crash(
    storage: Storage, make: Callable[..., str], answer_all: Callable[[str], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(queries, "BATCH", 10)
    unbegun = sa.select(surrogates.c.name).where(designs.IS_UNBEGUN | queries.IS_INCOMPLETE)
    monkeypatch.setattr(designs, "UNBEGUN", unbegun)  # without the minute in which the creating server may be alive
    planned = steps(np.arange(70.0).reshape(35, 2), np.full((35, 1), 0.5))
    with committed(storage) as commits:
        whole = make(queries=35, name="whole")
    assert len(commits) >= 4
    with monkeypatch.context() as patched:
        crash_at(patched, queries, "insert_queries", call=3)
        with pytest.raises(ZeroDivisionError):
            make(queries=35)
    assert storage.surrogates.summary(NAME).queries.pending == 20
    answer_all(NAME)
    assert storage.designs.due() == []
    assert storage.designs.unbegun() == [NAME]
    storage.designs.ask_first(NAME, planned)
    assert storage.designs.unbegun() == []
    for name in (whole, NAME):
        assert [query.coordinates for query in storage.queries.list(name)] == [query.coordinates for query in planned]
    answer_all(NAME)
    assert storage.designs.due() == [NAME]


def test_a_large_surrogate_is_deleted_in_limited_transactions_even_after_a_crash(
    storage: Storage, make: Callable[..., str], answer_all: Callable[[str], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stored, "BATCH", 10)
    kept, whole = make(name="kept"), make(queries=35, name="whole")
    with committed(storage) as commits:
        storage.surrogates.delete(whole)
    assert len(commits) >= 4
    old = storage.surrogates.get(make(queries=35)).id
    answer_all(NAME)
    with monkeypatch.context() as patched:
        crash_at(patched, stored, "_remove_some", call=12)
        with pytest.raises(ZeroDivisionError):
            storage.surrogates.delete(NAME)
    assert [one.name for one in storage.surrogates.summaries()] == [kept]
    with pytest.raises(UnknownSurrogate):
        storage.surrogates.name_of(old)
    make(queries=2)
    assert storage.surrogates.complete_removals() == 1
    assert storage.surrogates.complete_removals() == 0
    owners = {storage.surrogates.get(name).id for name in (kept, NAME)}
    with storage._database.read() as connection:  # type: ignore[attr-defined]
        assert {*connection.execute(sa.select(surrogates.c.id)).scalars()} == owners
        for table in metadata.sorted_tables:
            if "surrogate_id" in table.c:
                assert {*connection.execute(sa.select(table.c.surrogate_id)).scalars()} <= owners


def crash_at(patched: pytest.MonkeyPatch, module: ModuleType, function: str, call: int) -> None:
    """Let a call of a function raise, counted from 1."""
    calls, proper = itertools.count(1), getattr(module, function)

    def crashing(*arguments: object, **options: object) -> object:
        if next(calls) == call:
            raise ZeroDivisionError
        return proper(*arguments, **options)

    patched.setattr(module, function, crashing)


@contextmanager
def committed(storage: Storage) -> Iterator[list[object]]:
    """The transactions that a storage commits within the context."""
    commits: list[object] = []
    engine = storage._database._engine  # type: ignore[attr-defined]

    def note(connection: object) -> None:
        commits.append(connection)

    sa.event.listen(engine, "commit", note)
    yield commits
    sa.event.remove(engine, "commit", note)
