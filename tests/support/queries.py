"""Queries from arrays."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from surrogym_shared.nouns import Query


def steps(coordinates: ArrayLike, action: ArrayLike) -> tuple[Query, ...]:
    """A query of a single step for each row of coordinates (m, C) and action (m, F)."""
    rows = zip(np.asarray(coordinates).tolist(), np.asarray(action).tolist(), strict=True)
    return tuple(Query.step(*row) for row in rows)
