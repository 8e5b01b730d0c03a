"""Compiled code for learned regions of states: where episodes end, and where the reward jumps."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numba import types
from numpy.typing import NDArray

from surrogym_server.compiled.tables import TablesBuilder, matrix
from surrogym_server.environment.compiled.features import add_features, encode
from surrogym_server.environment.compiled.terms import add_terms, evaluate
from surrogym_server.environment.features import Encoder
from surrogym_server.gp.compiled import add_process, predict
from surrogym_server.models.gaussian_process.prediction.compiled.layout import (
    BLOCK,
    ENDING,
    HEAD,
    JUMPS,
    NONE,
    OBSERVE,
    READS_AFTER,
)
from surrogym_server.models.gaussian_process.prediction.regions import Classifier, Jump, Region, Thresholds
from surrogym_shared.compiled.jit import compiled, entry, inlined

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

# A region is stored as a matrix with a row for each of its forms (thresholds or a classifier). The columns are the
# weight of the form, whether it is a classifier, and three more numbers, most of them indices of other matrices.
# For thresholds: index of the axes, index of the cuts and rules, and whether the form is a complement.
# For a classifier: index of the features, index of the process, and number of features. If the process is constant, its
# index is -i - 1, with i the index of the constant.
WEIGHT, CLASSIFIES, FIRST, SECOND, THIRD = range(5)
LEAST_STD = 1e-9  # lower limit of a standard deviation, to avoid a division by 0


def add_region(tables: TablesBuilder, region: Region) -> int:
    """Add a learned region of states to the tables that compiled code reads. Return the index of its matrix."""
    return tables.add([(weight, *_add_form(tables, form)) for weight, form in region.forms])


def add_jumps(tables: TablesBuilder, jumps: Sequence[Jump]) -> int:
    """Add the jumps of a reward to the tables that compiled code reads. Return the index of a matrix with a row (size,
    index of the region) for each jump."""
    return tables.add(np.array([(jump.size, add_region(tables, jump.region)) for jump in jumps]).reshape(-1, 2))


def _add_form(tables: TablesBuilder, form: Thresholds | Classifier) -> tuple[float, ...]:
    if isinstance(form, Thresholds):
        columns, outside, width, membership = form._compiled
        cuts = tables.add(np.stack([columns, outside, width], 1), membership)
        return False, add_terms(tables, form._axes.terms), cuts, form.complement
    encoder = Encoder.of(form.definition, (form.process.feature_map,))
    features, process = add_features(tables, form.definition, encoder), form.process
    place = tables.add([process.centre])
    if process.posterior is not None:
        inputs = encoder.inputs(process.feature_map)
        place = add_process(tables, process.posterior, inputs, process.centre, process.scale)
    return True, features, place if process.posterior is not None else -place - 1, encoder.width(lead=True)


@inlined
def _within(numbers: Floats, places: Ints, axes: int, at: int, complement: int, q: Floats) -> Floats:
    cuts, membership = matrix(numbers, places, at), matrix(numbers, places, at + 1)
    values = evaluate(numbers, places, axes, q)
    terms, lanes = values.shape
    outside = np.ones(lanes)
    for r in range(membership.shape[1]):
        rule = np.zeros(lanes)
        for k in range(len(cuts)):
            if membership[k, r] == 0:
                continue
            term, side = int(cuts[k, 0]) % terms, int(cuts[k, 0]) // terms
            for b in range(lanes):
                v = values[term, b]
                v = v if side == 0 else (-v if side == 1 else abs(v))
                rule[b] += membership[k, r] * min(max((v - cuts[k, 1]) / cuts[k, 2], 0.0), 1.0)
        for b in range(lanes):
            outside[b] *= min(max(1.0 - rule[b], 0.0), 1.0)
    if not complement:
        for b in range(lanes):
            outside[b] = 1.0 - outside[b]
    return outside


@inlined
def _classified(
    numbers: Floats, places: Ints, features: int, process: int, width: int, observe: int, q: Floats, actions: int
) -> Floats:
    size, lanes = q.shape
    raw = np.zeros((size + actions, lanes))
    for c in range(size):
        for b in range(lanes):
            raw[c, b] = q[c, b]
    x = np.empty((width, lanes))
    encode(numbers, places, features, observe, raw, size, x, 0, width)
    mean, std = np.zeros(lanes), np.zeros(lanes)
    if process >= 0:
        predict(numbers, places, process, x, True, np.empty((0, 0)), mean, std)
    else:
        mean[:] = matrix(numbers, places, -process - 1)[0, 0]
    for b in range(lanes):
        z = mean[b] / max(std[b], LEAST_STD)
        mean[b] = 0.5 * math.erfc(-z / math.sqrt(2.0))
    return mean


@compiled
def probability(numbers: Floats, places: Ints, at: int, observe: int, q: Floats, actions: int) -> Floats:
    """Return the probability that each of B states lies inside a region, (B,).

    Args:
        numbers, places: tables of the model, see ``compiled.tables``.
        at: index of the region's matrix in the tables.
        observe: index, in the tables, of the terms that compute the observation.
        q: coordinates (C, B), each column a state.
        actions: number of action entries, F.
    """
    forms = matrix(numbers, places, at)
    total = np.zeros(q.shape[1])
    for f in range(len(forms)):
        weight, first, second, third = (
            forms[f, WEIGHT],
            int(forms[f, FIRST]),
            int(forms[f, SECOND]),
            int(forms[f, THIRD]),
        )
        if forms[f, CLASSIFIES]:
            inside = _classified(numbers, places, first, second, third, observe, q, actions)
        else:
            inside = _within(numbers, places, first, second, third, q)
        for b in range(len(total)):
            total[b] += weight * inside[b]
    for b in range(len(total)):
        total[b] = min(total[b], 1.0)  # because of rounding, the weighted sum may exceed 1
    return total


@inlined
def add_jumped(
    numbers: Floats, places: Ints, at: int, observe: int, q: Floats, actions: int, reward: Floats, variance: Floats
) -> None:
    """Add the jumps of the reward, which have the index ``at`` in the tables, to ``reward`` (B,), the rewards at the
    states q (C, B). Add to ``variance`` (B,) the variance of the reward where it is uncertain whether a state lies
    inside a jump's region. ``observe`` is the index, in the tables ``numbers`` and ``places``, of the terms that
    compute the observation; ``actions`` is the number of action entries."""
    jumps = matrix(numbers, places, at)
    free = np.ones(q.shape[1], dtype=np.bool_)
    for j in range(len(jumps)):
        size = jumps[j, 0]
        inside = probability(numbers, places, int(jumps[j, 1]), observe, q, actions)
        for b in range(len(free)):
            if free[b]:
                variance[b] += size * size * inside[b] * (1.0 - inside[b])
                if inside[b] > 0.5:
                    reward[b] += size
                free[b] = inside[b] <= 0.5


@entry(
    types.float64[::1],
    types.int64[:, ::1],
    types.float64[:, ::1],
    types.float64[:, ::1],
    types.int64,
    types.boolean,
    types.float64[::1],
    types.float64[:, ::1],
    types.boolean[::1],
)
def judge(
    numbers: Floats,
    places: Ints,
    q: Floats,
    q_next: Floats,
    actions: int,
    reward_std: bool,
    reward: Floats,
    std: Floats,
    terminated: Bools,
) -> None:
    """Add the learned jumps of the reward to the results of N steps, and decide by the learned region which steps end
    the episode. The results change in place.

    Args:
        numbers, places: tables of the model, see ``compiled.tables``.
        q, q_next: coordinates before and after the steps, (N, C).
        actions: number of action entries, F.
        reward_std: whether the standard deviation of the reward is needed.
        reward: (N,) rewards, to which jumps are added.
        std: (N, O) standard deviations. The last column, that of the reward, increases where the edges of jumps are
            uncertain.
        terminated: (N,) whether each step ends the episode; overwritten if termination is learned.
    """
    head = matrix(numbers, places, HEAD)
    observe = int(head[0, OBSERVE])
    for begin in range(0, len(q), BLOCK):
        lanes, size = min(BLOCK, len(q) - begin), q.shape[1]
        state, arrived = np.empty((size, lanes)), np.empty((size, lanes))
        for b in range(lanes):
            for c in range(size):
                arrived[c, b] = q_next[begin + b, c]
                state[c, b] = arrived[c, b] if head[0, READS_AFTER] else q[begin + b, c]
        pay, variance = np.zeros(lanes), np.zeros(lanes)
        add_jumped(numbers, places, int(head[0, JUMPS]), observe, state, actions, pay, variance)
        for b in range(lanes):
            reward[begin + b] += pay[b]
            if reward_std:
                known = std[begin + b, -1]
                std[begin + b, -1] = np.sqrt(known * known + variance[b])
        if head[0, ENDING] != NONE:
            inside = probability(numbers, places, int(head[0, ENDING]), observe, arrived, actions)
            for b in range(lanes):
                terminated[begin + b] = inside[b] > 0.5
