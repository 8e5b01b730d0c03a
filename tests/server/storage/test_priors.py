"""Priors: stored bit for bit, awaited without a fit, and replaced or removed with a new plan."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from surrogym_server.errors import LeaseExpired, UnknownSurrogate
from surrogym_server.storage.records import NewDesign
from surrogym_server.storage.sql import Storage

SECONDS = 60.0
BLOB, ABOUT = bytes(range(256)) * 3, {"source": "textbook", "parameters": [{"name": "mass"}]}


def test_a_stored_prior_is_read_back_unchanged_and_replaced_by_the_next(storage: Storage, make: Callable[..., str]):
    name = make()
    assert storage.priors.get(name) is None
    assert storage.priors.blob(name) is None
    storage.priors.put(name, b"earlier", {})
    storage.priors.put(name, BLOB, ABOUT)
    found = storage.priors.get(name)
    assert found is not None
    assert (found.about, found.awaited) == (ABOUT, False)
    assert storage.priors.blob(name) == BLOB


def test_no_fit_is_due_while_a_design_waits_for_its_prior(
    storage: Storage, make: Callable[..., str], answer_all: Callable[[str], None]
):
    name = make()
    storage.priors.wait(name)
    answer_all(name)
    found = storage.priors.get(name)
    assert found is not None
    assert found.awaited
    assert name not in storage.designs.due()
    assert storage.designs.begin(name, "me", SECONDS) is None
    storage.priors.put(name, BLOB, ABOUT)
    assert name in storage.designs.due()


def test_a_design_that_has_a_prior_does_not_wait_for_another(storage: Storage, make: Callable[..., str]):
    name = make()
    storage.priors.put(name, BLOB, ABOUT)
    storage.priors.wait(name)
    assert storage.priors.blob(name) == BLOB


def test_storing_a_prior_withdraws_pending_queries_and_makes_a_fit_due(
    storage: Storage, make: Callable[..., str], answer_all: Callable[[str], None], design: Callable[..., NewDesign]
):
    name = make()
    answer_all(name)
    lease = storage.designs.begin(name, "me", SECONDS)
    assert lease is not None
    storage.designs.commit(lease, design(queries=2))
    assert storage.queries.list(name, ("pending",))
    storage.priors.put(name, BLOB, ABOUT)
    assert not storage.queries.list(name, ("pending",))
    assert name in storage.designs.due()


def test_a_fit_that_runs_while_a_prior_is_stored_is_not_kept(
    storage: Storage, make: Callable[..., str], answer_all: Callable[[str], None], design: Callable[..., NewDesign]
):
    name = make()
    answer_all(name)
    without = storage.designs.begin(name, "me", SECONDS)
    assert without is not None
    storage.priors.put(name, BLOB, ABOUT)
    with pytest.raises(LeaseExpired):
        storage.designs.commit(without, design())
    beside = storage.designs.begin(name, "me", SECONDS)
    assert beside is not None
    assert storage.designs.commit(beside, design()) == 1


def test_removing_a_prior_makes_a_fit_without_it_due(
    storage: Storage, make: Callable[..., str], answer_all: Callable[[str], None]
):
    name = make()
    storage.priors.wait(name)
    answer_all(name)
    assert storage.priors.drop(name)
    assert not storage.priors.drop(name)
    assert storage.priors.get(name) is None
    assert name in storage.designs.due()


def test_deleting_a_surrogate_deletes_its_prior(storage: Storage, make: Callable[..., str]):
    name = make()
    storage.priors.put(name, BLOB, ABOUT)
    storage.surrogates.delete(name)
    for call in (storage.priors.get, storage.priors.blob, storage.priors.drop, storage.priors.wait):
        with pytest.raises(UnknownSurrogate):
            call(name)
