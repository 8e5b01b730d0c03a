"""The reservoir of visited states: bounded, uniform over all visits, and the same however they were batched."""

from __future__ import annotations

import numpy as np
import pytest

from surrogym_server.engine import session
from surrogym_server.engine.session import CAPACITY, Reservoir


def visit(batch: int, visits: int, seed: int = 5) -> Reservoir:
    reservoir = Reservoir(seed)
    for first in range(0, visits, batch):
        numbers = np.arange(first, min(first + batch, visits), dtype=float)
        reservoir = reservoir.visit(np.stack([numbers, -numbers], axis=-1))
    return reservoir


def test_all_visited_states_are_kept_below_the_reservoir_capacity():
    reservoir = visit(batch=7, visits=100)
    np.testing.assert_array_equal(reservoir.states[:, 0], np.arange(100))
    assert reservoir.visits == 100


def test_the_reservoir_of_visited_states_does_not_depend_on_batch_sizes(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(session, "CAPACITY", 100)  # batches of one take seconds to fill it
    visits = 211
    kept = [visit(batch, visits).states for batch in (1, 3, 64, visits)]
    assert len(kept[0]) == 100
    for other in kept[1:]:
        np.testing.assert_array_equal(other, kept[0])


def test_a_full_reservoir_is_a_uniform_sample_of_all_visited_states():
    visits = 8 * CAPACITY
    reservoir = visit(batch=1000, visits=visits)
    assert reservoir.states.shape == (CAPACITY, 2)
    assert reservoir.visits == visits
    quarters = np.histogram(reservoir.states[:, 0], bins=4, range=(0, visits))[0]
    expected, deviation = CAPACITY / 4, np.sqrt(CAPACITY * 3 / 16)
    assert np.abs(quarters - expected).max() < 5 * deviation


def test_another_seed_keeps_other_visited_states_in_the_reservoir():
    kept = [set(visit(1000, 4 * CAPACITY, seed).states[:, 0]) for seed in (1, 2)]
    assert kept[0] != kept[1]


def test_adding_visited_states_returns_a_new_reservoir_and_keeps_the_old():
    before = visit(batch=10, visits=10)
    before.visit(np.zeros((5, 2)))
    assert (before.visits, len(before.states)) == (10, 10)
