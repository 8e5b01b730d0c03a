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


def test_a_model_requested_several_times_is_loaded_once(cache: ModelCache, store: Store):
    assert [cast(str, cache.get(A, 1)) for _ in range(3)] == [f"{A} 1"] * 3
    assert store.loaded == [(A, 1)]


def test_a_model_is_moved_to_a_device_once_until_its_surrogate_is_forgotten(cache: ModelCache, store: Store):
    meta = torch.device("meta")
    moved = cache.get(A, 1, meta)
    assert (cast(str, moved), cache.get(A, 1, meta) is moved, store.loaded) == (f"{A} 1 on meta", True, [(A, 1)])
    cache.forget(A)
    assert cache.get(A, 1, meta) is not moved


def test_a_full_cache_drops_the_least_recently_used_model(cache: ModelCache, store: Store):
    for version in (1, 2, 1, 3, 1, 2):
        cache.get(A, version)
    assert store.loaded == [(A, 1), (A, 2), (A, 3), (A, 2)]


def test_a_published_model_becomes_the_latest_and_is_loaded_at_once(cache: ModelCache, store: Store):
    assert cache.latest(A) == 1
    cache.publish(A, 2)
    assert (cache.latest(A), store.loaded) == (2, [(A, 1), (A, 2)])
    cache.publish(A, 1)
    assert cache.latest(A) == 2, "an older one that comes late changes nothing"


def test_asking_for_the_latest_model_of_an_unfitted_surrogate_raises(cache: ModelCache):
    with pytest.raises(NoModel):
        cache.latest(NOBODY)


def test_a_forgotten_surrogate_reloads_its_latest_model_from_storage(cache: ModelCache, store: Store):
    cache.publish(A, 5)
    cache.forget(A)
    store.loaded.clear()
    assert cache.latest(A) == 1
    assert store.loaded == [(A, 1)]


def test_a_newer_model_stored_by_another_server_is_found(cache: ModelCache, store: Store):
    assert cache.latest(A) == 1
    store.newest[A] = 2
    assert (cache.latest(A), cache.refresh(A), cache.latest(A)) == (1, 2, 2), "when it is asked for"
    store.newest[A] = 3
    assert (cache.look(), cache.latest(A)) == ([], 3), "and when somebody looks"


def test_a_surrogate_deleted_by_another_server_is_reported_and_forgotten(cache: ModelCache, store: Store):
    cache.latest(A)
    del store.newest[A]
    assert (cache.look(), cache.latest(A)) == ([A], 1), "its sessions are ended first: a reset must not lack a model"
    cache.forget(A)
    with pytest.raises(NoModel):
        cache.latest(A)
    assert cache.look() == []


def test_if_the_newest_model_is_damaged_the_previous_one_becomes_the_latest(store: Store):
    newest = iter([{A: 3}, {A: 2}, {A: 2}, {A: 1}, {A: 1}])
    cache = ModelCache(store.load, lambda: next(newest), capacity=2)
    store.damaged = {2, 3}
    assert cache.latest(A) == 1
    assert store.loaded == [(A, 3), (A, 2), (A, 1)]


def test_a_cached_latest_model_that_proves_damaged_is_replaced_by_the_previous(cache: ModelCache, store: Store):
    store.newest[A] = 2
    assert cache.latest(A) == 2
    for other in (10, 11):
        cache.get(other, 1)  # so that it has to be loaded again
    store.damaged = {2}
    with pytest.raises(Damaged):
        cache.get(A, 2)
    store.newest[A] = 1
    assert cache.latest(A) == 1


def test_a_damaged_latest_model_without_an_older_one_raises(cache: ModelCache, store: Store):
    store.damaged = {1}
    with pytest.raises(Damaged, match="model 1"):
        cache.latest(A)
