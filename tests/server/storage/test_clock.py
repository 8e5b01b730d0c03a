"""A clock that is set back makes no lease last longer, and one that is set forward loses no answer."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import sqlalchemy as sa

from surrogym_server.errors import LeaseExpired
from surrogym_server.storage.records import NewDesign, NewSample
from surrogym_server.storage.sql import Storage
from surrogym_server.storage.sql.tables import Checked, metadata

DAY, LONG, SHORT = 86_400.0, 60.0, 0.05
Until = Callable[[Callable[[], bool]], None]
SetBack = Callable[[float], None]


def seconds_left(storage: Storage, name: str, query: int) -> float:
    left = storage.queries.get(name, query).lease_seconds_left
    assert left is not None
    return left


def test_these_clock_tests_cover_every_time_column_of_the_database() -> None:
    doubles = {column.name for table in metadata.tables.values() for column in table.c if is_double(column)}
    others = {"target", "reward", "seconds", "fit_seconds"}
    own = {"finished_at"}  # of jobs, a feature that may be deleted with its table
    assert doubles - others - own == {"created_at", "begun", "expires", "fit_expires"}


def is_double(column: sa.Column[object]) -> bool:
    return isinstance(column.type, Checked) and isinstance(column.type.impl, sa.Double)


def test_the_lease_of_a_dead_sampler_expires_although_the_clock_was_set_back(
    storage: Storage, make: Callable[..., str], set_clock_back: SetBack, until: Until
) -> None:
    name = make(queries=1)
    [dead] = storage.queries.claim(name, "dead", 1, SHORT)
    set_clock_back(DAY)
    until(lambda: storage.queries.sweep_expired() == 1)
    [again] = storage.queries.claim(name, "next", 1, LONG)
    assert again.id == dead.id


def test_a_live_sampler_keeps_its_lease_although_the_clock_was_set_back(
    storage: Storage,
    make: Callable[..., str],
    answer: Callable[..., NewSample],
    set_clock_back: SetBack,
) -> None:
    name = make(queries=2)
    kept, renewed = storage.queries.claim(name, "alive", 2, LONG)
    storage.queries.renew(name, renewed.id, renewed.token, 2 * LONG)
    set_clock_back(DAY)
    assert seconds_left(storage, name, kept.id) > LONG
    assert storage.queries.sweep_expired() == 0
    assert LONG / 2 < seconds_left(storage, name, kept.id) <= LONG
    assert LONG < seconds_left(storage, name, renewed.id) <= 2 * LONG, "what the renewal gave it"
    storage.queries.renew(name, kept.id, kept.token, LONG)
    added = storage.samples.add(name, "alive", [answer(kept), answer(renewed)])
    assert [sample.late for sample in storage.samples.page(name, 0, 10)] == [False, False]
    assert added.duplicates == 0


def test_the_sweep_of_expired_leases_does_not_shorten_leases_of_plausible_length(
    storage: Storage, make: Callable[..., str]
) -> None:
    name = make(queries=1)
    [leased] = storage.queries.claim(name, "alive", 1, LONG)
    for _ in range(5):
        storage.queries.sweep_expired()
    assert storage.queries.renew(name, leased.id, leased.token, LONG) >= leased.expires


def test_the_fit_lease_of_a_dead_server_expires_although_the_clock_was_set_back(
    storage: Storage,
    make: Callable[..., str],
    answer_all: Callable[[str], None],
    design: Callable[..., NewDesign],
    set_clock_back: SetBack,
) -> None:
    name = make()
    answer_all(name)
    dead = storage.designs.begin(name, "dead", LONG)
    assert dead is not None
    assert storage.designs.due() == []
    set_clock_back(DAY)
    assert storage.designs.due() == [name]
    heir = storage.designs.begin(name, "heir", LONG)
    assert heir is not None
    with pytest.raises(LeaseExpired):
        storage.designs.commit(dead, design())
    assert storage.designs.due() == []
    assert storage.designs.commit(heir, design()) == 1


def test_a_fit_can_be_committed_although_the_clock_was_set_back_meanwhile(
    storage: Storage,
    make: Callable[..., str],
    answer_all: Callable[[str], None],
    design: Callable[..., NewDesign],
    set_clock_back: SetBack,
) -> None:
    name = make()
    answer_all(name)
    lease = storage.designs.begin(name, "alive", LONG)
    assert lease is not None
    set_clock_back(DAY)
    lease = storage.designs.renew(lease, LONG)
    assert storage.designs.due() == [], "its heartbeat counts it anew"
    assert storage.designs.commit(lease, design()) == 1


def test_a_sample_is_stored_as_late_if_the_clock_was_set_forward(
    storage: Storage, make: Callable[..., str], answer: Callable[..., NewSample], set_clock_back: SetBack
) -> None:
    name = make(queries=1)
    [leased] = storage.queries.claim(name, "alive", 1, LONG)
    set_clock_back(-DAY)
    assert storage.queries.sweep_expired() == 1
    storage.samples.add(name, "alive", [answer(leased)])
    assert [sample.late for sample in storage.samples.page(name, 0, 10)] == [True]
    assert storage.surrogates.summary(name).queries.answered == 1
