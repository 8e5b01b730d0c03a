"""Interpolation on a grid agrees with SciPy's, also beyond its ends and around an angle."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit
from scipy.interpolate import RegularGridInterpolator

from surrogym_server.compiled.grid import interpolated, locate


@njit
def values_at(low, cell, count, cyclic, values, q):
    found = np.empty(len(q))
    nodes, weights = np.empty(1 << len(low), np.int64), np.empty(1 << len(low))
    for i in range(len(q)):
        locate(low, cell, count, cyclic, q[i], nodes, weights)
        found[i] = interpolated(values, nodes, weights)
    return found


@pytest.mark.parametrize("coordinates", [1, 2, 3, 4])
def test_values_between_nodes_are_interpolated_in_all_directions(coordinates: int):
    rng = np.random.default_rng(coordinates)
    low, cell = rng.normal(size=coordinates), rng.uniform(0.1, 1, size=coordinates)
    count = np.array([4, 3, 5, 2][:coordinates])
    cyclic = np.array([True, False, False, False][:coordinates])
    values = rng.normal(size=int(count.prod()))
    q = low + cell * count * rng.uniform(-0.5, 1.5, size=(200, coordinates))
    table = values.reshape(count[::-1]).transpose()
    table = np.concatenate([table, table[:1]])  # the first coordinate is an angle
    axes = [low[c] + cell[c] * np.arange(table.shape[c]) for c in range(coordinates)]
    inside = q.copy()
    inside[:, 0] = low[0] + (q[:, 0] - low[0]) % (cell[0] * count[0])
    for c in range(1, coordinates):
        inside[:, c] = inside[:, c].clip(axes[c][0], axes[c][-1])
    expected = RegularGridInterpolator(axes, table)(inside)
    np.testing.assert_allclose(values_at(low, cell, count, cyclic, values, q), expected, rtol=1e-9, atol=1e-9)


@njit
def nodes_at(low, cell, count, cyclic, q):
    nodes, weights = np.empty(1 << len(low), np.int64), np.empty(1 << len(low))
    locate(low, cell, count, cyclic, q, nodes, weights)
    return nodes


def test_a_state_that_is_not_a_number_reads_no_node_outside_of_the_grid():
    unknown = np.full(2, np.nan)
    for cyclic in ([True, False], [False, True]):
        nodes = nodes_at(np.zeros(2), np.ones(2), np.array([3, 3]), np.array(cyclic), unknown)
        assert ((nodes >= 0) & (nodes < 9)).all()
