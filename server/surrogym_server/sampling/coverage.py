"""Find the initial real steps of a design that need not be taken, because a log contains similar steps."""

from __future__ import annotations

import numpy as np
import scipy  # SciPy imports its submodules on first use, so a server that needs none of them starts sooner
from numpy.typing import NDArray

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_shared.spec import limits

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]


def covered(definition: EnvironmentDefinition, q: Array, u: Array, logged_q: Array, logged_u: Array) -> Bools:
    """Return for each of m planned steps (queries) whether it is unnecessary because a logged step lies close enough,
    (m,) bool.

    A query is unnecessary if its distance to the nearest logged step is less than half its distance to the nearest
    other query.

    Distances combine the differences of all coordinates and actions, in widths of the sampling range; those of angles
    are measured around the circle. Two different discrete actions have the distance 1. If there is only one query, any
    log makes it unnecessary.

    Args:
        definition: the environment.
        q, u: the queries, (m, C) and (m, F).
        logged_q, logged_u: the logged steps, (n, C) and (n, F).
    """
    if not len(q) or not len(logged_q):
        return np.zeros(len(q), dtype=np.bool_)
    queries, steps = _places(definition, q, u), _places(definition, logged_q, logged_u)
    tree = scipy.spatial.cKDTree(queries)
    other = tree.query(queries, k=2)[0][:, 1]  # distance to the nearest other query, infinite if there is none
    nearest: Array = scipy.spatial.cKDTree(steps).query(queries)[0]
    result: Bools = nearest < 0.5 * other
    return result


def _places(definition: EnvironmentDefinition, q: Array, u: Array) -> Array:
    """Map n states q (n, C) and actions u (n, F) to points (n, D) whose Euclidean distances say how similar the steps
    are. Coordinates and actions are divided by the width of their range, angles become points on a circle, and two
    different discrete actions have the distance 1."""
    columns: list[Array] = []
    for index, coordinate in enumerate(definition.coordinates):
        if coordinate.kind == "angle":
            columns += [np.sin(q[:, index]) / 2, np.cos(q[:, index]) / 2]
        else:
            low, high = limits(coordinate.sampling)
            columns.append((q[:, index] - low) / ((high - low) or 1.0))
    for entry, count in enumerate(definition.action.nvec):
        columns += [np.where(u[:, entry] == value, np.sqrt(0.5), 0.0) for value in range(count)]
    if not definition.action.nvec:
        least, most = definition.action_limits
        columns += list(((u - least) / (most - least)).T)
    return np.stack(columns, 1)
