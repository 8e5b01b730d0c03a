"""Rules of a step in compiled code: limits, walls, wrapped angles, and coordinates read back from an observation."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from surrogym_server.compiled.elementary import wrapped
from surrogym_server.compiled.tables import TablesBuilder, matrix
from surrogym_server.environment.definition import EnvironmentDefinition, LagDefinition
from surrogym_server.environment.observation_inverse import ObservationInverse
from surrogym_shared.compiled.jit import compiled, inlined

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# Columns of the rules, one row for each coordinate: lower and upper limit of predictions; lower and upper bound; index
# of the coordinate that becomes 0 at a bound, or -1; whether the coordinate is an angle. Two columns are for lags,
# which repeat a past value, and -1 for other coordinates: how the lag is computed, and the index of its source in
# [coordinates, action].
REACH_LOW, REACH_HIGH, LOW, HIGH, STOPS, ANGLE, LAG, SOURCE = range(8)
# How a lag is computed from its source: change in the step, change of an angle, value before the step, or this value
# plus 1.
CHANGE, TURN, REPEAT, COUNT = range(4)


def add_rules(tables: TablesBuilder, definition: EnvironmentDefinition) -> int:
    """Add to the tables the matrix of rules, which ``settle`` and ``repeat`` read, and return its index."""
    low, high = (end.tolist() for end in definition.reach)
    return tables.add(
        [
            (
                *(low[i], high[i], c.low, c.high, -1 if c.stops is None else c.stops, c.kind == "angle"),
                *((-1, -1) if c.lag is None else _lag(definition, i, c.lag)),
            )
            for i, c in enumerate(definition.coordinates)
        ]
    )


def _lag(definition: EnvironmentDefinition, index: int, lag: LagDefinition) -> tuple[int, int]:
    match lag.kind:
        case "steps":
            return COUNT, index
        case "action":
            return REPEAT, len(definition.coordinates) + lag.source
        case "value":
            return REPEAT, lag.source
        case "change":
            return TURN if definition.coordinates[lag.source].kind == "angle" else CHANGE, lag.source


def add_inverse(tables: TablesBuilder, inverse: ObservationInverse | None) -> int:
    """Add a matrix that says from which entries of an observation each moving coordinate is computed, and return its
    index. Its rows are (coordinate, entry, -1), or for an angle (coordinate, cosine, sine). It is empty without an
    inverse."""
    sources = () if inverse is None else inverse.sources
    rows = [(index, *entries, *[-1] * (2 - len(entries))) for index, entries in sources]
    return tables.add(np.array(rows).reshape(-1, 3))


@compiled
def clipped(rules: Floats, c: int, value: float) -> float:
    """Return a value of coordinate c, clipped to the coordinate's limits (see ``EnvironmentDefinition.reach``)."""
    low, high = rules[c, REACH_LOW], rules[c, REACH_HIGH]
    return low if value < low else (high if value > high else value)


@inlined
def settle(rules: Floats, q: Floats) -> None:
    """Apply the rules of the environment to coordinates q (C, B) in place: clip them to limits, set a speed that points
    into a wall to 0, wrap angles."""
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
    """Set the lags among the next coordinates q (C, B). A lag is a coordinate that repeats a past value; it is computed
    from ``raw`` (C + F, B), the coordinates and action before the step."""
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
    """Compute the moving coordinates from observations o (D, B), and write them to q (C, B). ``at`` is the index of the
    matrix from ``add_inverse``."""
    sources = matrix(numbers, places, at)
    for s in range(len(sources)):
        c, first, second = int(sources[s, 0]), int(sources[s, 1]), int(sources[s, 2])
        for b in range(q.shape[1]):
            q[c, b] = o[first, b] if second < 0 else math.atan2(o[second, b], o[first, b])
