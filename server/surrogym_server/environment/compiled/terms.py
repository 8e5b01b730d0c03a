"""Evaluation of terms (functions of the coordinates) and of inequalities between terms and numbers in compiled code."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from surrogym_server.compiled.elementary import sine_and_cosine
from surrogym_server.compiled.tables import Tables, TablesBuilder, matrix
from surrogym_server.environment.conditions import Conditions
from surrogym_server.environment.terms import TermSet
from surrogym_shared.compiled.jit import compiled

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# Compiled code reads a ``TermSet`` as four matrices. These are their offsets from the first one.
CONSTANT, FREQUENCIES, COEFFICIENTS, LIMITS = range(4)
# Compiled code reads conditions as two matrices. These are their offsets from the first one. TERMS: the index of their
# term set, and the number of groups. RULES: a row (sign, threshold, group) for each inequality.
TERMS, RULES = range(2)


def add_terms(tables: TablesBuilder, terms: TermSet) -> int:
    """Append the four matrices of a term set to the tables, and return the index of the first one."""
    unlimited = np.full((2, len(terms.constant)), np.inf) * [[-1], [1]]
    limits = unlimited if terms.low is None or terms.high is None else [terms.low.numpy(), terms.high.numpy()]
    return tables.add(terms.constant, terms.frequencies.T, terms.coefficients, limits)


def tables_of(terms: TermSet) -> Tables:
    """Return tables that contain only this term set, with its first matrix at index 0."""
    tables = TablesBuilder()
    add_terms(tables, terms)
    return tables.build()


def add_conditions(tables: TablesBuilder, conditions: Conditions) -> int:
    """Append the matrices of the conditions to the tables, after those of their terms. Return the index of the
    conditions' first matrix."""
    terms = add_terms(tables, conditions.terms)
    group = conditions.membership.numpy().argmax(1) if conditions.membership.numel() else np.zeros(0)
    rules = np.stack([conditions.sign, conditions.threshold, group], 1)
    return tables.add([[terms, conditions.membership.shape[1]]], rules)


@compiled
def evaluate(numbers: Floats, places: Ints, at: int, q: Floats) -> Floats:
    """Return the values (T, B) of T terms for the coordinates q (C, B) of B lanes. ``at`` is the index, in the tables
    ``numbers`` and ``places``, of the first matrix of the terms."""
    constant, frequencies = matrix(numbers, places, at + CONSTANT), matrix(numbers, places, at + FREQUENCIES)
    coefficients, limits = matrix(numbers, places, at + COEFFICIENTS), matrix(numbers, places, at + LIMITS)
    size, lanes = q.shape
    waves = len(frequencies)
    basis = np.empty((2 * waves, lanes))
    phase = np.empty(lanes)
    for wave in range(waves):
        phase[:] = 0.0
        for c in range(size):
            if frequencies[wave, c] != 0:
                for b in range(lanes):
                    phase[b] += frequencies[wave, c] * q[c, b]
        sine_and_cosine(phase, basis[wave], basis[waves + wave])
    values = np.empty((constant.shape[1], lanes))
    for t in range(len(values)):
        values[t, :] = constant[0, t]
        for c in range(coefficients.shape[1]):
            weight = coefficients[t, c]
            if weight != 0:
                entry = q[c] if c < size else basis[c - size]
                for b in range(lanes):
                    values[t, b] += weight * entry[b]
        low, high = limits[0, t], limits[1, t]
        if low > -np.inf or high < np.inf:
            for b in range(lanes):
                v = values[t, b]
                values[t, b] = low if v < low else (high if v > high else v)
    return values


@compiled
def holding(numbers: Floats, places: Ints, at: int, q: Floats) -> NDArray[np.bool_]:
    """Return (G, B) bool: which of G groups of inequalities hold for the coordinates q (C, B) of B lanes. ``at`` is the
    index, in the tables ``numbers`` and ``places``, of the first matrix of the conditions."""
    head, rules = matrix(numbers, places, at + TERMS), matrix(numbers, places, at + RULES)
    values = evaluate(numbers, places, int(head[0, 0]), q)
    holds = np.ones((int(head[0, 1]), q.shape[1]), dtype=np.bool_)
    for k in range(len(rules)):
        sign, threshold, group = rules[k, 0], rules[k, 1], int(rules[k, 2])
        for b in range(q.shape[1]):
            holds[group, b] &= sign * values[k, b] >= threshold
    return holds
