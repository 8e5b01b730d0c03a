"""Functions on a grid of states in compiled code: interpolation, and sweeps of value iteration.

A grid has ``count[c]`` nodes along coordinate c, from ``low[c]`` in steps of ``cell[c]``. Where ``cyclic[c]`` is true,
the last node is a neighbour of the first. Nodes are numbered with the first coordinate running fastest. States outside
of the grid count as its nearest state.

Shapes: S nodes, C coordinates, A actions, F action entries.
"""

from __future__ import annotations

import math

import numpy as np
from numba import types
from numpy.typing import NDArray

from surrogym_shared.compiled.jit import compiled, entry

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

# types of the four arrays that describe a grid: low, cell, count, cyclic
GRID = (types.float64[::1], types.float64[::1], types.int64[::1], types.boolean[::1])


@compiled
def locate(low: Floats, cell: Floats, count: Ints, cyclic: Bools, q: Floats, nodes: Ints, weights: Floats) -> None:
    """Find the cell of the grid that contains the state q (C,).

    Write the numbers of the nodes at its corners to ``nodes`` (2^C,), and their weights in a multilinear interpolation
    to ``weights`` (2^C,). Bit c of a corner's index is 1 at the cell's upper end along coordinate c.
    """
    nodes[0], weights[0] = 0, 1.0
    stride, corners = 1, 1
    for c in range(len(low)):
        at = (q[c] - low[c]) / cell[c]
        if cyclic[c]:
            at -= count[c] * math.floor(at / count[c])
            at = at if at > 0.0 else 0.0  # also if it is not a number
            lower = min(int(at), count[c] - 1)
            upper = lower + 1 if lower + 1 < count[c] else 0
        else:
            at = min(at if at > 0.0 else 0.0, count[c] - 1.0)
            lower = min(int(at), count[c] - 2)
            upper = lower + 1
        share = at - lower
        for k in range(corners):
            nodes[corners + k], weights[corners + k] = nodes[k] + upper * stride, weights[k] * share
            nodes[k], weights[k] = nodes[k] + lower * stride, weights[k] * (1.0 - share)
        stride *= count[c]
        corners *= 2


@compiled
def interpolated(values: Floats, nodes: Ints, weights: Floats) -> float:
    """Return the multilinear interpolation of values (S,) in a cell that ``locate`` found."""
    total = 0.0
    for k in range(len(nodes)):
        total += weights[k] * values[nodes[k]]
    return total


@entry(
    *GRID,
    types.float32[:, :, ::1],
    types.float32[:, ::1],
    types.float64,
    types.boolean,
    types.boolean,
    types.float64[::1],
    types.int64[::1],
)
def sweep(
    low: Floats,
    cell: Floats,
    count: Ints,
    cyclic: Bools,
    q_next: Singles,
    reward: Singles,
    discount: float,
    all_actions: bool,
    upwards: bool,
    values: Floats,
    best: Ints,
) -> float:
    """Update the values (S,) of all nodes once, in place and in order of their numbers, and return the largest change.

    Args:
        low, cell, count, cyclic: the grid.
        q_next: (S, A, C) state after one step from each node with each action; not a number where the episode ended.
        reward: (S, A) reward of the step.
        discount: factor of the value of the next state.
        all_actions: whether the best action of each node is chosen again; otherwise ``best`` is evaluated.
        upwards: whether the numbers of the nodes rise.
        values: (S,) values, updated.
        best: (S,) index of the best action of each node; updated with ``all_actions``.
    """
    nodes, weights, q = np.empty(1 << len(low), np.int64), np.empty(1 << len(low)), np.empty(len(low))
    change = 0.0
    for i in range(len(values)):
        s = i if upwards else len(values) - 1 - i
        top, chosen = -np.inf, best[s]
        for a in range(reward.shape[1]):
            if not all_actions and a != best[s]:
                continue
            # Written out here and in ``choose``: a function of so many arrays is not inlined, and takes 3 times as long
            value = float(reward[s, a])
            if not np.isnan(q_next[s, a, 0]):
                for c in range(len(q)):
                    q[c] = q_next[s, a, c]
                locate(low, cell, count, cyclic, q, nodes, weights)
                value += discount * interpolated(values, nodes, weights)
            if value > top:
                top, chosen = value, a
        change = max(change, abs(top - values[s]))
        values[s], best[s] = top, chosen
    return change


@entry(
    *GRID,
    types.float32[:, :, ::1],
    types.float32[:, ::1],
    types.float64,
    types.float64[::1],
    types.float64[:, ::1],
    types.float64[:, ::1],
)
def choose(
    low: Floats,
    cell: Floats,
    count: Ints,
    cyclic: Bools,
    q_next: Singles,
    reward: Singles,
    discount: float,
    values: Floats,
    levels: Floats,
    table: Floats,
) -> None:
    """Write the best action of each node to ``table`` (S, F). A continuous one is the maximum of a parabola through the
    values of the best level of each entry and its two neighbours.

    Args:
        low, cell, count, cyclic, q_next, reward, discount, values: as in ``sweep``.
        levels: (F, L) equally spaced values of each entry; (0, 0) for discrete actions. Action number a has level
            (a // L^(F - 1 - f)) % L of entry f.
        table: (S, F) actions, written; a discrete one is its number.
    """
    nodes, weights, q = np.empty(1 << len(low), np.int64), np.empty(1 << len(low)), np.empty(len(low))
    entries, number = levels.shape
    of_action = np.empty(reward.shape[1])
    for s in range(len(values)):
        for a in range(len(of_action)):
            of_action[a] = float(reward[s, a])
            if not np.isnan(q_next[s, a, 0]):
                for c in range(len(q)):
                    q[c] = q_next[s, a, c]
                locate(low, cell, count, cyclic, q, nodes, weights)
                of_action[a] += discount * interpolated(values, nodes, weights)
        best, stride = int(np.argmax(of_action)), 1
        if entries == 0:
            table[s, 0] = best
        for f in range(entries - 1, -1, -1):
            level = best // stride % number
            table[s, f] = levels[f, level]
            if 0 < level < number - 1:
                below, above = of_action[best - stride], of_action[best + stride]
                bend = below - 2.0 * of_action[best] + above
                if bend < 0:
                    table[s, f] += 0.5 * (below - above) / bend * (levels[f, 1] - levels[f, 0])
            stride *= number


@compiled
def policy_action(
    low: Floats,
    cell: Floats,
    count: Ints,
    cyclic: Bools,
    table: Floats,
    choices: int,
    q: Floats,
    nodes: Ints,
    weights: Floats,
    votes: Floats,
    u: Floats,
) -> None:
    """Write the action of a policy that is given at the nodes to u (F,).

    Args:
        low, cell, count, cyclic: the grid.
        table: (S, F) action of each node.
        choices: number of discrete actions, of which the one with the largest weight is taken; 0 for continuous
            actions, which are interpolated.
        q: (C,) state.
        nodes, weights, votes: arrays (2^C,), (2^C,) and (choices,) that are overwritten.
        u: (F,) the action.
    """
    locate(low, cell, count, cyclic, q, nodes, weights)
    u[:] = 0.0
    votes[:] = 0.0
    for k in range(len(nodes)):
        if choices:
            votes[int(table[nodes[k], 0])] += weights[k]
        else:
            for f in range(len(u)):
                u[f] += weights[k] * table[nodes[k], f]
    if choices:
        u[0] = float(np.argmax(votes))
