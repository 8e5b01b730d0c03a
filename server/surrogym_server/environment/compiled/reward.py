"""Evaluation of a declared reward in compiled code."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from surrogym_server.compiled.elementary import exponential
from surrogym_server.compiled.tables import TablesBuilder, matrix
from surrogym_server.environment.compiled.terms import add_conditions, add_terms, evaluate, holding
from surrogym_server.environment.declared_reward import RewardFunction
from surrogym_shared.compiled.jit import inlined

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

SHAPES = {"one": 0, "linear": 1, "absolute": 2, "square": 3, "bump": 4, "ball": 5}
ONE, LINEAR, ABSOLUTE, SQUARE, BUMP, BALL = SHAPES.values()
# Compiled code reads a declared reward as three matrices. These are their offsets from the first one. HEAD: the indices
# of its quantities' terms and of its conditions. WEIGHTS: weights (F, X) of F action entries in X quantities. TERMS: a
# row (weight, code of the shape, number of quantities) for each reward term.
HEAD, WEIGHTS, TERMS = range(3)


def add_reward(tables: TablesBuilder, reward: RewardFunction) -> int:
    """Append the matrices of a declared reward to the tables, and return the index of the first one."""
    head = [add_terms(tables, reward.values), add_conditions(tables, reward.conditions)]
    terms = [(term.weight, SHAPES[term.shape], len(term.of)) for term in reward.declared.terms]
    return tables.add(head, reward.weights, np.array(terms).reshape(-1, 3))


@inlined
def add_declared(numbers: Floats, places: Ints, at: int, q: Floats, u: Floats, total: Floats) -> None:
    """Add to ``total`` (B,) the declared reward of B lanes with states q (C, B) and actions u (F, B). ``at`` is the
    index of the reward's first matrix in the tables ``numbers`` and ``places``."""
    head, weights = matrix(numbers, places, at + HEAD), matrix(numbers, places, at + WEIGHTS)
    terms = matrix(numbers, places, at + TERMS)
    lanes = q.shape[1]
    x = evaluate(numbers, places, int(head[0, 0]), q)
    for f in range(len(weights)):
        for i in range(len(x)):
            if weights[f, i] != 0:
                for b in range(lanes):
                    x[i, b] += weights[f, i] * u[f, b]
    holds = holding(numbers, places, int(head[0, 1]), q)
    begin, shaped = 0, np.empty(lanes)
    for t in range(len(terms)):
        weight, shape, count = terms[t, 0], int(terms[t, 1]), int(terms[t, 2])
        shaped[:] = 1.0 if shape == ONE else 0.0
        for i in range(begin, begin + count):
            for b in range(lanes):
                v = x[i, b]
                if shape == LINEAR:
                    shaped[b] += v
                elif shape == ABSOLUTE:
                    shaped[b] += abs(v)
                elif shape in (SQUARE, BUMP, BALL):
                    shaped[b] += v * v
        if shape == BUMP:
            for b in range(lanes):
                shaped[b] *= -0.5
            exponential(shaped)
        if shape == BALL:
            for b in range(lanes):
                shaped[b] = 1.0 if shaped[b] <= 1.0 else 0.0
        begin += count
        for b in range(lanes):
            if holds[t, b]:
                total[b] += weight * shaped[b]
