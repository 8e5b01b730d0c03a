"""The cache of models: each version is loaded once, the newest is known, and deleted ones are forgotten."""

from __future__ import annotations

from typing import Any, cast

import pytest

from surrogym_server.engine.models import ModelCache
from surrogym_server.errors import NoModel


class Store:
    """Versions by surrogate; a model is its own name."""

    def __init__(self) -> None:
        self.newest = {"a": 1}
        self.loaded: list[tuple[str, int]] = []

    def load(self, name: str, version: int) -> Any:
        self.loaded.append((name, version))
        return f"{name}{version}"

    def latest(self, name: str) -> int:
        if name not in self.newest:
            raise NoModel("none yet")
        return self.newest[name]


@pytest.fixture
def store() -> Store:
    return Store()


@pytest.fixture
def cache(store: Store) -> ModelCache:
    return ModelCache(store.load, store.latest, capacity=2)


def test_a_model_is_loaded_once(cache: ModelCache, store: Store):
    assert [cast(str, cache.get("a", 1)) for _ in range(3)] == ["a1"] * 3
    assert store.loaded == [("a", 1)]


def test_the_least_recently_used_is_dropped(cache: ModelCache, store: Store):
    for version in (1, 2, 1, 3, 1, 2):
        cache.get("a", version)
    assert store.loaded == [("a", 1), ("a", 2), ("a", 3), ("a", 2)]


def test_what_is_published_is_the_newest_and_loaded_already(cache: ModelCache, store: Store):
    assert cache.latest("a") == 1
    cache.publish("a", 2)
    assert (cache.latest("a"), store.loaded) == (2, [("a", 1), ("a", 2)])
    cache.publish("a", 1)
    assert cache.latest("a") == 2, "an older one that comes late changes nothing"


def test_there_may_be_none(cache: ModelCache):
    with pytest.raises(NoModel):
        cache.latest("nobody")


def test_a_deleted_surrogate_begins_again(cache: ModelCache, store: Store):
    cache.publish("a", 5)
    cache.forget("a")
    store.loaded.clear()
    assert cache.latest("a") == 1
    assert store.loaded == [("a", 1)]
