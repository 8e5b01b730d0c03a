"""Occupancy, saved sessions and events."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest
import sqlalchemy as sa

from surrogym_server.storage.records import NewDesign, NewSample, SavedSession
from surrogym_server.storage.sql import Storage, events
from surrogym_server.storage.sql.rows import append_event, hold


def test_visited_states_are_found_by_policy_checkpoint_or_as_the_latest(
    storage: Storage, make: Callable[..., str]
) -> None:
    name = make()
    early, late = np.random.default_rng(0).normal(size=(2, 7, 2))
    assert storage.occupancy.latest(name) is None
    storage.occupancy.put(name, "early", early)
    storage.occupancy.put(name, "late", late)
    found = storage.occupancy.get(name, "early")
    assert found is not None
    assert found.states.tobytes() == early.tobytes()
    assert found.states.shape == (7, 2)
    newest = storage.occupancy.latest(name)
    assert newest is not None
    assert newest.checkpoint == "late"
    assert storage.occupancy.get(name, "never") is None


def test_visited_states_stored_under_an_existing_checkpoint_replace_it(
    storage: Storage, make: Callable[..., str]
) -> None:
    name = make()
    for checkpoint, value in (("a", 1.0), ("b", 2.0), ("a", 3.0)):
        storage.occupancy.put(name, checkpoint, np.full((1, 2), value))
    newest = storage.occupancy.latest(name)
    assert newest is not None
    assert (newest.checkpoint, newest.states.tolist()) == ("a", [[3.0, 3.0]])


def test_visited_states_are_stored_with_their_design_round(
    storage: Storage,
    make: Callable[..., str],
    answer_all: Callable[[str], None],
    design: Callable[..., NewDesign],
) -> None:
    name = make()
    answer_all(name)
    lease = storage.designs.begin(name, "me", 60)
    assert lease is not None
    storage.designs.commit(lease, design())
    storage.occupancy.put(name, "c", np.zeros((0, 2)))
    found = storage.occupancy.get(name, "c")
    assert found is not None
    assert (found.round, found.states.shape) == (1, (0, 2))


def test_saved_sessions_are_deleted_from_storage_when_a_server_restores_them(storage: Storage) -> None:
    storage.sessions.save([])
    storage.sessions.save([SavedSession("s", "p", b"old"), SavedSession("t", "p", b"\0\xff")])
    storage.sessions.save([SavedSession("s", "p", b"new")])
    taken = sorted(storage.sessions.take(), key=lambda session: session.id)
    assert taken == [SavedSession("s", "p", b"new"), SavedSession("t", "p", b"\0\xff")]
    assert storage.sessions.take() == []


def test_events_of_a_surrogate_are_listed_in_order(
    storage: Storage,
    make: Callable[..., str],
    answer_all: Callable[[str], None],
    design: Callable[..., NewDesign],
    by_hand: Callable[..., NewSample],
) -> None:
    name = make(queries=2)
    make(name="another")
    answer_all(name)
    lease = storage.designs.begin(name, "me", 60)
    assert lease is not None
    storage.designs.commit(lease, design(queries=1))
    storage.ledger.report(name, 10, key="k")
    events = storage.events.list(name)
    kinds = [event.kind for event in events]
    assert kinds == ["created", "queries", "sample", "phase", "fit", "queries", "phase", "ledger"]
    ids = [event.id for event in events]
    assert ids == sorted(set(ids))
    assert events[2].body["sampler"] == "worker"
    assert events[4].body["version"] == 1
    assert storage.events.list(name, after=ids[3]) == events[4:]
    assert storage.events.list(name, limit=2) == events[:2]


def test_stored_times_are_seconds_since_1970(storage: Storage, make: Callable[..., str]) -> None:
    name = make(queries=1)
    created = storage.surrogates.get(name).created_at
    [leased] = storage.queries.claim(name, "a", 1, 60.0)
    assert 1.7e9 < created < 1e11
    assert 60.0 <= leased.expires - created < 600.0


def test_finding_the_newest_event_takes_a_constant_number_of_statements(
    storage: Storage, make: Callable[..., str]
) -> None:
    name, another = make(), make(name="another")
    asked = []
    for _ in range(2):
        with statements(storage) as sent:
            newest = storage.events.newest([name, another, "unknown"])
        asked.append(len(sent))
        assert newest == {one: storage.events.list(one, limit=10_000)[-1].id for one in (name, another)}
        append(storage, name, 2_500)
    assert asked[0] == asked[1]


def test_the_oldest_events_are_deleted_in_transactions_of_limited_size(
    storage: Storage, make: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(events, "BATCH", 20)
    name, another = make(), make(name="another")
    append(storage, name, 90)
    before, other = storage.events.list(name), storage.events.list(another)
    with statements(storage) as sent:
        assert storage.events.prune(keep=30) == len(before) - 30
    assert storage.events.list(name) == before[-30:]
    assert storage.events.list(another) == other
    assert sum(statement.startswith("DELETE") for statement in sent) > 60 / 20
    with statements(storage) as sent:
        assert storage.events.prune(keep=30) == 0
    assert len(sent) == 2, "a surrogate without a new event is skipped"


def append(storage: Storage, name: str, count: int) -> None:
    with storage._database.write() as connection:  # type: ignore[attr-defined]
        held = hold(connection, name)
        for _ in range(count):
            append_event(connection, held, "sample")


@contextmanager
def statements(storage: Storage) -> Iterator[list[str]]:
    """The statements that a storage sends within the context, without those of transactions."""
    sent: list[str] = []
    engine = storage._database._engine  # type: ignore[attr-defined]

    def note(_: object, __: object, statement: str, *___: object) -> None:
        if not statement.startswith("BEGIN"):
            sent.append(statement)

    sa.event.listen(engine, "before_cursor_execute", note)
    yield sent
    sa.event.remove(engine, "before_cursor_execute", note)
