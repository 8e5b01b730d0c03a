"""Outcome of a move: state, rewards, ends and observations of lanes."""

from __future__ import annotations

import numpy as np
from numba import types
from numpy.typing import NDArray

from surrogym_server.environment.compiled.terms import evaluate
from surrogym_server.virtual.lanes import ENDED, RUNNING
from surrogym_shared.compiled.jit import entry

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Phases = NDArray[np.int8]

BLOCK = 64


@entry(types.float64[::1], types.int64[:, ::1], types.float64[:, ::1], types.float32[:, ::1])
def observe(numbers: Floats, places: Ints, q: Floats, observation: Singles) -> None:
    """Observations (N, D) of coordinates q (N, C)."""
    size = q.shape[1]
    for begin in range(0, len(q), BLOCK):
        lanes = min(BLOCK, len(q) - begin)
        block = np.empty((size, lanes))
        for b in range(lanes):
            for c in range(size):
                block[c, b] = q[begin + b, c]
        values = evaluate(numbers, places, 0, block)
        for b in range(lanes):
            for d in range(len(values)):
                observation[begin + b, d] = np.float32(values[d, b])


@entry(
    types.boolean[::1],
    types.float64[:, ::1],
    types.float64[::1],
    types.float64[:, ::1],
    types.boolean[::1],
    types.float64[::1],
    types.float64,
    types.float64,
    types.float64,
    types.int64,
    types.float64[:, ::1],
    types.int64[::1],
    types.int8[::1],
    types.float64[:, ::1],
    types.boolean[:, ::1],
)
def conclude(
    moving: Bools,
    q_next: Floats,
    pay: Floats,
    deviation: Floats,
    over: Bools,
    scales: Floats,
    terminal_reward: float,
    penalty: float,
    trust: float,
    time_limit: int,
    q: Floats,
    elapsed: Ints,
    phase: Phases,
    rewards: Floats,
    ends: Bools,
) -> int:
    """Complete the step of the moving lanes (N,), whose moves are given in rows (K, ...), in place.

    Args:
        trust, time_limit: infinite and -1 if there is none.
        q, elapsed, phase: of all lanes.
        rewards: penalised rewards and means, (2, N).
        ends: terminated, truncated, untrusted, and any of them, (4, N).

    Returns:
        The number of lanes that ended.
    """
    row = count = 0
    for n in range(len(moving)):
        for k in range(len(ends)):
            ends[k, n] = False
        rewards[0, n] = rewards[1, n] = 0.0
        if not moving[n]:
            continue
        mean = pay[row] + terminal_reward if over[row] else pay[row]
        outputs = deviation.shape[1]
        doubtful = False
        if trust < np.inf:
            for o in range(outputs):
                doubtful |= deviation[row, o] > trust * scales[o]
        elapsed[n] += 1
        late = time_limit >= 0 and elapsed[n] >= time_limit
        ends[0, n], ends[1, n], ends[2, n] = over[row], late or doubtful, doubtful
        ended = over[row] or late or doubtful
        ends[3, n] = ended
        phase[n] = ENDED if ended else RUNNING
        count += ended
        rewards[1, n] = mean
        rewards[0, n] = mean if penalty == 0 else mean - penalty * deviation[row, outputs - 1]
        for c in range(q.shape[1]):
            q[n, c] = q_next[row, c]
        row += 1
    return count
