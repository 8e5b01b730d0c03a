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

# Compiled code reads limits as a matrix with a row (low, high, margin, unit) for each of them, and the matrices of
# their terms after it.
ENDS, TERMS = range(2)


def tables_of(limits: LimitSet, unit: Tensor) -> Tables:
    """Return the tables of L limits, and of the unit (L,) in which the distance beyond each of them is measured."""
    tables = TablesBuilder()
    tables.add(np.stack([limits.low, limits.high, limits.margin, unit], 1))
    add_terms(tables, limits.terms)
    return tables.build()


@compiled
def beyond(numbers: Floats, places: Ints, q: Floats) -> Floats:
    """Return for states q (B, C) the largest distance beyond any limit's end less its margin, in the limit's unit,
    (B,); 0 for states that keep all limits."""
    ends, values = matrix(numbers, places, ENDS), evaluate(numbers, places, TERMS, np.ascontiguousarray(q.T))
    most = np.zeros(len(q))
    for k in range(len(ends)):
        low, high, margin, unit = ends[k, 0], ends[k, 1], ends[k, 2], ends[k, 3]
        for b in range(len(q)):
            room = min(values[k, b] - low, high - values[k, b])
            most[b] = max(most[b], (margin - room) / unit)
    return most
