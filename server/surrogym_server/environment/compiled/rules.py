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

# Columns of the rules, one row for each coordinate: ends of its reach, its bounds, the coordinate that they stop or -1,
# and whether it is an angle; then, for a lag, how it repeats a value, and from which row of coordinates and action (-1
# if it is no lag).
REACH_LOW, REACH_HIGH, LOW, HIGH, STOPS, ANGLE, LAG, SOURCE = range(8)
# How a lag repeats: change of a coordinate, change of an angle, value before the step, or value before the step plus 1.
CHANGE, TURN, REPEAT, COUNT = range(4)


def add_rules(tables: TablesBuilder, definition: EnvironmentDefinition) -> int:
    """Add the matrix that ``settle`` and ``repeat`` read to the tables, and return its index."""
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
    """Add the entries from which moving coordinates are read back to the tables, -1 for none, and return their
    index."""
    sources = () if inverse is None else inverse.sources
    rows = [(index, *entries, *[-1] * (2 - len(entries))) for index, entries in sources]
    return tables.add(np.array(rows).reshape(-1, 3))


@compiled
def clipped(rules: Floats, c: int, value: float) -> float:
    """Return a value of coordinate c, clipped to its reach."""
    low, high = rules[c, REACH_LOW], rules[c, REACH_HIGH]
    return low if value < low else (high if value > high else value)


@inlined
def settle(rules: Floats, q: Floats) -> None:
    """Apply the rules of the environment to coordinates q (C, B) in place: clip, stop at walls, wrap angles."""
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
    """Set the lags of next coordinates q (C, B) to the values of coordinates and action, raw (C + F, B), that they
    repeat."""
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
    """Read the moving coordinates back from observations o (D, B), and write them to q (C, B); ``at`` is the index of
    the inverse."""
    sources = matrix(numbers, places, at)
    for s in range(len(sources)):
        c, first, second = int(sources[s, 0]), int(sources[s, 1]), int(sources[s, 2])
        for b in range(q.shape[1]):
            q[c, b] = o[first, b] if second < 0 else math.atan2(o[second, b], o[first, b])
