"""Rules of a step in compiled code: limits, walls, wrapped angles, and coordinates read back from an observation."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from surrogym_server.compiled.elementary import wrapped
from surrogym_server.compiled.tables import TablesBuilder, matrix
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.observation_inverse import ObservationInverse
from surrogym_shared.compiled.jit import compiled, inlined
from surrogym_shared.kinds import LagKind

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# Columns of the matrix of rules, which has a row for each coordinate. REACH_LOW, REACH_HIGH: predictions are clipped to
# these limits. LOW, HIGH: declared bounds. STOPS: index of the coordinate that becomes 0 at a bound, or -1. ANGLE: 1
# for an angle. For a coordinate that repeats a past value (a lag), LAG is how it is computed and SOURCE the index of
# the value in [coordinates, action]; for other coordinates, both are -1.
REACH_LOW, REACH_HIGH, LOW, HIGH, STOPS, ANGLE, LAG, SOURCE = range(8)
# How a lag, a coordinate that repeats a past value, follows from another coordinate or an action entry: CHANGE is its
# change in the step, TURN the change of an angle, REPEAT its value before the step, COUNT that value plus 1.
CHANGE, TURN, REPEAT, COUNT = range(4)


def add_rules(tables: TablesBuilder, definition: EnvironmentDefinition) -> int:
    """Add to the tables a matrix of limits, bounds, angles and lags, one row for each coordinate. Return its index."""
    low, high = (end.tolist() for end in definition.reach)
    return tables.add(
        [
            (
                *(low[i], high[i], *c.saturation, -1 if stopped is None else stopped, c.kind == "angle"),
                *((-1, -1) if c.lag is None else (_lag(definition, c.lag.kind, source), source)),
            )
            for i, (c, stopped, source) in enumerate(
                zip(definition.coordinates, definition.stopped, definition.sources, strict=True)
            )
        ]
    )


def _lag(definition: EnvironmentDefinition, kind: LagKind, source: int) -> int:
    if kind == "change":
        return TURN if definition.coordinates[source].kind == "angle" else CHANGE
    return COUNT if kind == "steps" else REPEAT


def add_inverse(tables: TablesBuilder, inverse: ObservationInverse | None) -> int:
    """Add to the tables a matrix that says from which entries of an observation each moving coordinate is computed, and
    return its index. A row has three indices: (coordinate, entry, -1), or for an angle (coordinate, entry of its
    cosine, entry of its sine). If ``inverse`` is None, the matrix has no rows."""
    sources = () if inverse is None else inverse.sources
    rows = [(index, *entries, *[-1] * (2 - len(entries))) for index, entries in sources]
    return tables.add(np.array(rows).reshape(-1, 3))


@compiled
def clipped(rules: Floats, c: int, value: float) -> float:
    """Return ``value``, clipped to the limits of the coordinate with index c (see ``EnvironmentDefinition.reach``).
    ``rules`` is the matrix that ``add_rules`` added."""
    low, high = rules[c, REACH_LOW], rules[c, REACH_HIGH]
    return low if value < low else (high if value > high else value)


@inlined
def settle(rules: Floats, q: Floats) -> None:
    """Apply the rules of the environment to the coordinates q (C, B) of B lanes in place: clip them to limits, set a
    speed that points into a wall to 0, wrap angles. ``rules`` is the matrix that ``add_rules`` added."""
    size, lanes = q.shape
    for c in range(size):
        for b in range(lanes):
            q[c, b] = clipped(rules, c, q[c, b])
    for c in range(size):
        stopped = int(rules[c, STOPS])
        if stopped >= 0:
            for b in range(lanes):
                speed = q[stopped, b]
                if (q[c, b] <= rules[c, LOW] and speed < 0) or (q[c, b] >= rules[c, HIGH] and speed > 0):
                    q[stopped, b] = 0.0
        if rules[c, ANGLE]:
            for b in range(lanes):
                q[c, b] = wrapped(q[c, b])


@inlined
def repeat(rules: Floats, raw: Floats, q: Floats) -> None:
    """Set the lags among the coordinates q (C, B) of B lanes after a step. A lag is a coordinate that repeats a past
    value; it is computed from ``raw`` (C + F, B), the coordinates before the step and the action. ``rules`` is the
    matrix that ``add_rules`` added."""
    size, lanes = q.shape
    for c in range(size):
        lag, source = int(rules[c, LAG]), int(rules[c, SOURCE])
        if lag < 0:
            continue
        for b in range(lanes):
            value = raw[source, b]
            if lag == COUNT:
                value += 1.0
            elif lag != REPEAT:
                value = q[source, b] - value
            q[c, b] = clipped(rules, c, wrapped(value) if lag == TURN else value)


@inlined
def recover(numbers: Floats, places: Ints, at: int, o: Floats, q: Floats) -> None:
    """Compute the moving coordinates of B lanes from observations o (D, B), and write them to q (C, B). ``at`` is the
    index, in the tables ``numbers`` and ``places``, of the matrix that ``add_inverse`` added."""
    sources = matrix(numbers, places, at)
    for s in range(len(sources)):
        c, first, second = int(sources[s, 0]), int(sources[s, 1]), int(sources[s, 2])
        for b in range(q.shape[1]):
            q[c, b] = o[first, b] if second < 0 else math.atan2(o[second, b], o[first, b])
