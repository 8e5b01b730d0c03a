"""What a sampler and a fit hand to storage."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from support.queries import steps
from surrogym_server.storage.records import LeasedQuery, NewDesign, NewModel, NewSample
from surrogym_server.storage.sql import Storage
from surrogym_shared.nouns import Query

SECONDS = 60.0  # a lease no test outlives


@pytest.fixture
def answer() -> Callable[..., NewSample]:
    """The sample that answers a leased query."""

    def sample_for(query: LeasedQuery, **changes: Any) -> NewSample:
        coordinates = query.coordinates or (0.0, 1.0)
        values: dict[str, Any] = {
            "coordinates": coordinates,
            "action": tuple(query.actions[changes.get("step", 0)]),
            "next_coordinates": tuple(q + 0.1 for q in coordinates),
            "reward": -1.25,
            "terminated": False,
            "query_id": query.id,
            "lease_token": query.token,
        }
        return NewSample(**values | changes)

    return sample_for


@pytest.fixture
def by_hand() -> Callable[..., NewSample]:
    """A sample without a query."""

    def sample(reward: float = 0.0, **changes: Any) -> NewSample:
        values: dict[str, Any] = {"coordinates": (1.0, 2.0), "action": (0.5,), "next_coordinates": (1.5, 2.5)}
        return NewSample(**values | changes, reward=reward, terminated=False)

    return sample


@pytest.fixture
def answer_all(storage: Storage, answer: Callable[..., NewSample]) -> Callable[[str], None]:
    """Claim and answer what is pending."""

    def run(name: str) -> None:
        claimed = storage.queries.claim(name, "worker", 100, SECONDS)
        storage.samples.add(name, "worker", [answer(query) for query in claimed])

    return run


@pytest.fixture
def design() -> Callable[..., NewDesign]:
    """What a fit gives, with these next queries, or with as many."""

    def make_design(queries: int | tuple[Query, ...] = 0, **changes: Any) -> NewDesign:
        model = NewModel(
            samples=3,
            data_hash="abc",
            fidelity={"target": 0.999, "confidence_index": 0.9},
            description={},
            fit_seconds=0.5,
            blob=b"\0model",
        )
        values: dict[str, Any] = {"model": model, "state": {"round": 1}, "phase": "sampling"}
        if isinstance(queries, int):
            queries = steps(np.ones((queries, 2)), np.ones((queries, 1)))
        return NewDesign(**values | changes, queries=queries)

    return make_design
