"""Features (inputs of models) in compiled code, with the same results as ``environment.features.Encoder``."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from surrogym_server.compiled.elementary import sine_and_cosine, wrapped
from surrogym_server.compiled.tables import TablesBuilder, matrix
from surrogym_server.environment.compiled.terms import evaluate
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.features import Encoder
from surrogym_server.tensors import EDGE
from surrogym_shared.compiled.jit import compiled

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# Compiled code reads an encoder as two matrices. These are their offsets from the first one. ROWS: for each feature,
# the code of its function, the index of the value that it reads, centre, scale and rate. WEIGHTS: for each feature, a
# weight for each coordinate.
ROWS, WEIGHTS = range(2)
FUNCTIONS = ("affine", "cos", "sin", "turned_cos", "turned_sin", "wrapped", "equal", "observed", "grown")
CODES = {function: code for code, function in enumerate(FUNCTIONS)}
AFFINE, COS, SIN, TURNED_COS, TURNED_SIN, WRAPPED, EQUAL, OBSERVED, GROWN = CODES.values()
UNIT_ANGLE = math.sqrt(3) / math.pi  # uniformly distributed angles times this factor have standard deviation 1


def add_features(tables: TablesBuilder, definition: EnvironmentDefinition, encoder: Encoder) -> int:
    """Add the features of an encoder to the tables, and return the index of their first matrix.

    Features of the lead (the predicted next values of the leading coordinates) come last. The indices of
    the values that features read refer to the sequence [coordinates, action, lead].
    """
    size = len(definition.coordinates)
    rows, weights = np.zeros((len(encoder.columns), 5)), np.zeros((len(encoder.columns), size))
    for feature, column in encoder.columns.items():
        beyond = size + definition.action.size if feature.function == "lead" else 0
        code = CODES["affine" if feature.function == "lead" else feature.function]
        rows[column] = code, beyond + feature.entry, feature.centre, feature.scale, feature.rate
        if feature.weights:
            weights[column] = feature.weights
    return tables.add(rows, weights)


@compiled
def encode(
    numbers: Floats, places: Ints, at: int, observe: int, raw: Floats, size: int, x: Floats, begin: int, end: int
) -> None:
    """Compute features ``begin`` to ``end - 1``, by index, for B lanes, and write each to its row of x (d, B).

    Args:
        numbers, places: tables of matrices, see ``compiled.tables``.
        at: index of the encoder's first matrix in the tables.
        observe: index, in the tables, of the terms that compute the observation.
        raw: coordinates, action and lead (next values of the L leading coordinates), (C + F + L, B).
        size: number of coordinates, C.
        x: array of d rows, one for each feature.
        begin, end: first index, and last index plus 1.
    """
    rows, weights = matrix(numbers, places, at + ROWS), matrix(numbers, places, at + WEIGHTS)
    lanes = raw.shape[1]
    other, phase = np.empty(lanes), np.empty(lanes)
    shown, observed = raw, False
    for f in range(begin, end):
        code, entry, centre, scale = int(rows[f, 0]), int(rows[f, 1]), rows[f, 2], rows[f, 3]
        if code == AFFINE:
            for b in range(lanes):
                x[f, b] = (raw[entry, b] - centre) / scale
        elif code == GROWN:
            rate, sign = abs(rows[f, 4]), math.copysign(1.0, rows[f, 4])
            steepest = math.exp(rate * EDGE)
            for b in range(lanes):
                along = max(sign * (raw[entry, b] - centre) / scale, -EDGE)
                bent = math.expm1(rate * min(along, EDGE)) / rate
                x[f, b] = sign * (bent + steepest * max(along - EDGE, 0.0))
        elif code == COS:
            sine_and_cosine(raw[entry], other, x[f])
        elif code == SIN:
            sine_and_cosine(raw[entry], x[f], other)
        elif code in (TURNED_COS, TURNED_SIN):
            phase[:] = 0.0
            for c in range(size):
                for b in range(lanes):
                    phase[b] += weights[f, c] * raw[c, b]
            if code == TURNED_COS:
                sine_and_cosine(phase, other, x[f])
            else:
                sine_and_cosine(phase, x[f], other)
        elif code == WRAPPED:
            for b in range(lanes):
                x[f, b] = wrapped(raw[entry, b]) * UNIT_ANGLE
        elif code == EQUAL:
            for b in range(lanes):
                x[f, b] = 1.0 if raw[entry, b] == centre else 0.0
        else:
            if not observed:
                shown, observed = evaluate(numbers, places, observe, raw[:size]), True
            for b in range(lanes):
                x[f, b] = (shown[entry, b] - centre) / scale
