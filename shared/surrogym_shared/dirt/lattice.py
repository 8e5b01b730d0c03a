"""Encoders: the readings of a coordinate are whole multiples of a width.

Shapes: T steps of a rollout, R measured coordinates, k numbers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from surrogym_shared.dirt.rollouts import Array, Rollout, Sensors, changes

ROUNDING = 1e-6  # a number counts as a multiple if it is off by at most this share of the largest change
WIDEST = 30  # a width is at least this multiple of the rounding
MULTIPLES = 5  # fewest different multiples of a width
FITTING = 0.95  # share of the changes that must fit: a wrapped angle may not
PARTS = 6  # the smallest distance of two changes is tried as up to this many widths


def widths(rollouts: Sequence[Rollout], known: Sensors) -> dict[str, float]:
    """Return the width of the lattice of each coordinate, by name, that has one."""
    found = {}
    for i, name in enumerate(known.names):
        moved = np.concatenate([changes(rollout, known.turning)[:, i] for rollout in rollouts])
        starts = np.array([rollout.read[0, i] - rollouts[0].read[0, i] for rollout in rollouts])
        if known.moving[i] and (width := _width(moved, starts[starts != 0])) is not None:
            found[name] = width
    return found


def _width(moved: Array, starts: Array) -> float | None:
    """Return the largest width of which changes ``moved`` (k,) and differences of starts are multiples; None if there
    is none.

    Differences of starts tell a lattice of the sensor from changes that are multiples of one action's effect.
    """
    sizes = np.unique(np.abs(moved))
    most = ROUNDING * float(sizes[-1])
    distances = np.diff(np.concatenate([[0.0], sizes]))
    if not (distances := distances[distances > 2 * most]).size:
        return None
    for part in range(1, PARTS + 1):
        width = float(distances.min()) / part
        counts = np.round(sizes / width)
        if len(np.unique(counts[counts > 0])) < MULTIPLES:
            continue
        # the multiples themselves give a width that is more exact than one distance
        width = float(counts @ sizes / (counts @ counts))
        if width < WIDEST * most:
            return None
        if np.mean(_off(moved, width) <= most) >= FITTING and np.all(_off(starts, width) <= 2 * most):
            return width
    return None


def _off(numbers: Array, width: float) -> Array:
    off: Array = np.abs(numbers - width * np.round(numbers / width))
    return off


def turns(width: float) -> int:
    """Return the number of counts of a whole turn."""
    return round(2 * math.pi / width)
