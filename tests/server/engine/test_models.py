"""The cache of models: each version is loaded once, the newest is known, and deleted ones are forgotten."""

from __future__ import annotations

from typing import Any, cast

import pytest
import torch

from surrogym_server.engine.models import ModelCache
from surrogym_server.errors import Damaged, NoModel

A, NOBODY = 7, 8


class Named(str):
    """A model that is its own name, and says where it lives."""

    def on(self, device: torch.device) -> Named:
        return Named(f"{self} on {device}")


class Store:
    """Newest versions by surrogate; a model is its own name."""

    def __init__(self) -> None:
        self.newest = {A: 1}
        self.loaded: list[tuple[int, int]] = []
        self.damaged: set[int] = set()

    def load(self, surrogate: int, version: int) -> Any:
        self.loaded.append((surrogate, version))
        if version in self.damaged:
            raise Damaged(f"model {version}")
        return Named(f"{surrogate} {version}")


@pytest.fixture
def store() -> Store:
    return Store()


@pytest.fixture
def cache(store: Store) -> ModelCache:
    return ModelCache(store.load, lambda: store.newest, capacity=2)


def test_a_model_is_loaded_once(cache: ModelCache, store: Store):
    assert [cast(str, cache.get(A, 1)) for _ in range(3)] == [f"{A} 1"] * 3
    assert store.loaded == [(A, 1)]


def test_a_model_is_moved_to_a_device_once_and_forgotten_there_too(cache: ModelCache, store: Store):
    meta = torch.device("meta")
    moved = cache.get(A, 1, meta)
    assert (cast(str, moved), cache.get(A, 1, meta) is moved, store.loaded) == (f"{A} 1 on meta", True, [(A, 1)])
    cache.forget(A)
    assert cache.get(A, 1, meta) is not moved


def test_the_least_recently_used_is_dropped(cache: ModelCache, store: Store):
    for version in (1, 2, 1, 3, 1, 2):
        cache.get(A, version)
    assert store.loaded == [(A, 1), (A, 2), (A, 3), (A, 2)]


def test_the_published_version_is_the_newest_and_already_loaded(cache: ModelCache, store: Store):
    assert cache.latest(A) == 1
    cache.publish(A, 2)
    assert (cache.latest(A), store.loaded) == (2, [(A, 1), (A, 2)])
    cache.publish(A, 1)
    assert cache.latest(A) == 2, "an older one that comes late changes nothing"


def test_there_may_be_none(cache: ModelCache):
    with pytest.raises(NoModel):
        cache.latest(NOBODY)


def test_a_deleted_surrogate_begins_again(cache: ModelCache, store: Store):
    cache.publish(A, 5)
    cache.forget(A)
    store.loaded.clear()
    assert cache.latest(A) == 1
    assert store.loaded == [(A, 1)]


def test_data_stored_by_another_server_are_seen(cache: ModelCache, store: Store):
    assert cache.latest(A) == 1
    store.newest[A] = 2
    assert (cache.latest(A), cache.refresh(A), cache.latest(A)) == (1, 2, 2), "when it is asked for"
    store.newest[A] = 3
    assert (cache.look(), cache.latest(A)) == ([], 3), "and when somebody looks"


def test_a_surrogate_that_another_server_has_deleted_is_gone(cache: ModelCache, store: Store):
    cache.latest(A)
    del store.newest[A]
    assert (cache.look(), cache.latest(A)) == ([A], 1), "its sessions are ended first: a reset must not lack a model"
    cache.forget(A)
    with pytest.raises(NoModel):
        cache.latest(A)
    assert cache.look() == []


def test_where_the_newest_is_set_aside_the_one_before_it_is_the_latest(store: Store):
    newest = iter([{A: 3}, {A: 2}, {A: 2}, {A: 1}, {A: 1}])
    cache = ModelCache(store.load, lambda: next(newest), capacity=2)
    store.damaged = {2, 3}
    assert cache.latest(A) == 1
    assert store.loaded == [(A, 3), (A, 2), (A, 1)]


def test_a_known_latest_that_is_found_damaged_is_known_no_longer(cache: ModelCache, store: Store):
    store.newest[A] = 2
    assert cache.latest(A) == 2
    for other in (10, 11):
        cache.get(other, 1)  # so that it has to be loaded again
    store.damaged = {2}
    with pytest.raises(Damaged):
        cache.get(A, 2)
    store.newest[A] = 1
    assert cache.latest(A) == 1


def test_a_damaged_newest_model_that_was_not_set_aside_raises(cache: ModelCache, store: Store):
    store.damaged = {1}
    with pytest.raises(Damaged, match="model 1"):
        cache.latest(A)
