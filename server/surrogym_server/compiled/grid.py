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
def locate(low: Floats, cell: Floats, count: Ints, cyclic: Bools, q: Floats, ends: Ints, share: Floats) -> None:
    """Find the cell of the grid that contains the state q (C,).

    Write to ``ends`` (C, 2) what the cell's lower and upper end along each coordinate add to the number of a node, and
    to ``share`` (C,) how far q is from the lower to the upper end, from 0 to 1.
    """
    stride = 1
    for c in range(len(low)):
        at = (q[c] - low[c]) / cell[c]
        if cyclic[c]:
            at -= count[c] * math.floor(at / count[c])
            lower = min(int(at), count[c] - 1)
            upper = lower + 1 if lower + 1 < count[c] else 0
        else:
            at = min(max(at, 0.0), count[c] - 1.0)
            lower = min(int(at), count[c] - 2)
            upper = lower + 1
        ends[c, 0], ends[c, 1] = lower * stride, upper * stride
        share[c] = at - lower
        stride *= count[c]


@compiled
def corner(k: int, ends: Ints, share: Floats) -> tuple[int, float]:
    """Return the node at corner number k of a cell that ``locate`` found, from 0 to 2^C - 1, and its weight in a
    multilinear interpolation."""
    node, weight = 0, 1.0
    for c in range(len(share)):
        upper = k >> c & 1
        node += ends[c, upper]
        weight *= share[c] if upper else 1.0 - share[c]
    return node, weight


@compiled
def interpolated(values: Floats, ends: Ints, share: Floats) -> float:
    """Return the multilinear interpolation of values (S,) in a cell that ``locate`` found."""
    total = 0.0
    for k in range(1 << len(share)):
        node, weight = corner(k, ends, share)
        if weight > 0:
            total += weight * values[node]
    return total


@compiled
def action_value(
    low: Floats,
    cell: Floats,
    count: Ints,
    cyclic: Bools,
    q_next: Singles,
    reward: float,
    discount: float,
    values: Floats,
    ends: Ints,
    share: Floats,
    q: Floats,
) -> float:
    """Return the reward of a step plus the discounted value of the state after it, ``q_next`` (C,), which is not a
    number where the episode ended. ``ends`` (C, 2), ``share`` and ``q`` (C,) are overwritten."""
    if np.isnan(q_next[0]):
        return reward
    for c in range(len(q)):
        q[c] = q_next[c]
    locate(low, cell, count, cyclic, q, ends, share)
    return reward + discount * interpolated(values, ends, share)


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
    ends, share, q = np.empty((len(low), 2), np.int64), np.empty(len(low)), np.empty(len(low))
    change = 0.0
    for i in range(len(values)):
        s = i if upwards else len(values) - 1 - i
        top, chosen = -np.inf, best[s]
        for a in range(reward.shape[1]):
            if not all_actions and a != best[s]:
                continue
            value = action_value(
                low, cell, count, cyclic, q_next[s, a], float(reward[s, a]), discount, values, ends, share, q
            )
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
    ends, share, q = np.empty((len(low), 2), np.int64), np.empty(len(low)), np.empty(len(low))
    entries, number = levels.shape
    of_action = np.empty(reward.shape[1])
    for s in range(len(values)):
        for a in range(len(of_action)):
            of_action[a] = action_value(
                low, cell, count, cyclic, q_next[s, a], float(reward[s, a]), discount, values, ends, share, q
            )
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
    ends: Ints,
    share: Floats,
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
        ends, share, votes: arrays (C, 2), (C,) and (choices,) that are overwritten.
        u: (F,) the action.
    """
    locate(low, cell, count, cyclic, q, ends, share)
    u[:] = 0.0
    votes[:] = 0.0
    for k in range(1 << len(share)):
        node, weight = corner(k, ends, share)
        if weight == 0:
            continue
        if choices:
            votes[int(table[node, 0])] += weight
        else:
            for f in range(len(u)):
                u[f] += weight * table[node, f]
    if choices:
        u[0] = float(np.argmax(votes))
