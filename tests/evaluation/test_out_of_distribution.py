"""A policy that goes where a log has never been is found out, and one that keeps to the log is left alone."""

from __future__ import annotations

import numpy as np
import pytest

from surrogym_sampler.original.classic import pendulum
from surrogym_trainer.evaluation.out_of_distribution import LITTLE, outside_of


def steps(speeds: tuple[float, float], rows: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    q = np.stack([rng.uniform(-np.pi, np.pi, rows), rng.uniform(*speeds, rows)], axis=1)
    return q, rng.uniform(-2, 2, (rows, 1))


@pytest.mark.parametrize("seed", range(5))
def test_visited_states_within_the_log_are_not_reported_as_outside(seed: int) -> None:
    found = outside_of(pendulum(), *steps((-2, 2), 1_000, seed), *steps((-1.9, 1.9), 400, seed + 100))
    assert found.share < 0.01
    assert not found.much


def test_visited_states_with_unlogged_speeds_are_reported_with_coordinate_and_range() -> None:
    found = outside_of(pendulum(), *steps((-2, 2), 1_000, 0), *steps((6, 8), 400, 1))
    assert found.share == 1.0
    assert found.much
    assert found.name == "speed"
    assert "100 % of the policy's steps lie outside the log, with speed between 6" in found.words()


def test_visited_states_in_a_gap_of_the_log_are_reported_as_outside() -> None:
    low, high = steps((-8, -6), 500, 0), steps((6, 8), 500, 1)
    log = tuple(np.concatenate(pair) for pair in zip(low, high, strict=True))
    found = outside_of(pendulum(), *log, *steps((-0.5, 0.5), 400, 2))
    assert found.much
    assert found.name == ""


def test_actions_that_the_log_does_not_contain_are_reported_as_outside() -> None:
    q, u = steps((-2, 2), 1_000, 0)
    way_q, way_u = steps((-2, 2), 400, 1)
    assert outside_of(pendulum(), q, 0.05 * u, way_q, 0.05 * way_u).share < LITTLE
    assert outside_of(pendulum(), q, 0.05 * u, way_q, np.full_like(way_u, 2.0)).share > 0.9


def test_visited_angles_one_turn_away_are_not_reported_as_outside_the_log() -> None:
    q, u = steps((-2, 2), 1_000, 0)
    way_q, way_u = steps((-2, 2), 400, 1)
    assert outside_of(pendulum(), q, u, way_q + np.array([2 * np.pi, 0]), way_u).share < 0.01
