"""Compiled code that computes how far states are beyond limits."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from surrogym_server.compiled.tables import Tables, TablesBuilder, matrix
from surrogym_server.environment.compiled.terms import add_terms, evaluate
from surrogym_server.environment.safety import LimitSet
from surrogym_shared.compiled.jit import compiled

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# Compiled code reads limits as a matrix with a row (low, high, margin, unit, ahead) for each of them, and the matrices
# of their terms after it.
ENDS, TERMS = range(2)


def tables_of(limits: LimitSet, unit: Tensor, ahead: Tensor) -> Tables:
    """Return the tables of L limits; of the unit (L,) in which the distance beyond each of them is measured; and of
    whether it is also measured one step ahead, (L,) bool."""
    tables = TablesBuilder()
    tables.add(np.stack([limits.low, limits.high, limits.margin, unit, ahead], 1))
    add_terms(tables, limits.terms)
    return tables.build()


@compiled
def beyond(numbers: Floats, places: Ints, before: Floats, q: Floats) -> Floats:
    """Return for states q (B, C), after a step from ``before`` (B, C), the largest distance beyond any limit's end less
    its margin, in the limit's unit, (B,); 0 for states that keep all limits. One step ahead means after another step in
    which the distance changes as much, as in ``surrogym_shared.limits.is_near``."""
    ends, values = matrix(numbers, places, ENDS), evaluate(numbers, places, TERMS, np.ascontiguousarray(q.T))
    earlier = evaluate(numbers, places, TERMS, np.ascontiguousarray(before.T))
    most = np.zeros(len(q))
    for k in range(len(ends)):
        low, high, margin, unit, ahead = ends[k]
        for b in range(len(q)):
            room = min(values[k, b] - low, high - values[k, b])
            if ahead:
                room = min(room, 2 * room - min(earlier[k, b] - low, high - earlier[k, b]))
            most[b] = max(most[b], (margin - room) / unit)
    return most
