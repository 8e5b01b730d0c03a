"""Outcome of a step in compiled code: states, rewards, terminations and observations of lanes."""

from __future__ import annotations

import numpy as np
from numba import types
from numpy.typing import NDArray

from surrogym_server.environment.compiled.terms import evaluate
from surrogym_server.virtual.lanes import ENDED, RUNNING
from surrogym_shared.compiled.jit import entry, inlined

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Phases = NDArray[np.int8]

BLOCK = 64  # number of lanes (parallel environments) whose observations are computed at once


@entry(types.float64[::1], types.int64[:, ::1], types.float64[:, ::1], types.float32[:, ::1])
def observe(numbers: Floats, places: Ints, q: Floats, observation: Singles) -> None:
    """Write the observations of N states, given by their coordinates q (N, C), to ``observation`` (N, D).

    ``numbers`` and ``places`` are the tables (see ``compiled.tables``) of the terms that compute the D entries.
    """
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


@inlined
def _exceeds(std: Floats, trust: float, scales: Floats) -> bool:
    doubtful = False
    for o in range(len(std)):
        doubtful |= std[o] > trust * scales[o]
    return doubtful


@inlined
def _is_outside(q: Floats, inside: Floats) -> bool:
    outside = False
    for c in range(len(q)):
        outside |= not inside[0, c] <= q[c] <= inside[1, c]
    return outside


@entry(
    types.boolean[::1],
    types.float64[:, ::1],
    types.float64[::1],
    types.float64[:, ::1],
    types.boolean[::1],
    types.boolean[::1],
    types.float64[::1],
    types.float64,
    types.float64,
    types.float64,
    types.int64,
    types.float64[:, ::1],
    types.float64,
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
    std: Floats,
    over: Bools,
    fallen: Bools,
    scales: Floats,
    terminal_reward: float,
    penalty: float,
    trust: float,
    time_limit: int,
    inside: Floats,
    outside_reward: float,
    q: Floats,
    elapsed: Ints,
    phase: Phases,
    rewards: Floats,
    ends: Bools,
) -> int:
    """Complete a step of N lanes (parallel environments), some of which move: compute their rewards, penalties and ends
    of episodes from the predictions. The last five array arguments are changed in place.

    Args:
        moving: (N,) mask of the lanes that move. Row k of q_next, pay, std, over and fallen belongs to the k-th of
            these.
        q_next, pay, std, over: predicted coordinates (K, C), rewards (K,), standard deviations (K, O) and terminations
            (K,) of the K lanes that move.
        fallen: (K,) mask of the lanes whose episode ends because, at the machine, the fallback action of the declared
            limits would take over; (0,) without limits.
        scales: (O,) standard deviation of each output over the samples.
        terminal_reward: reward that terminating steps pay in addition.
        penalty, trust, time_limit: fields of ``VirtualSettings``. A field that is None there is infinite (trust) or -1
            (time_limit) here.
        inside: lower and upper ends of the sampling range, (2, C), if an episode ends when it leaves this range,
            otherwise (0, 0).
        outside_reward: reward of a lane whose episode ended early: outside the sampling range, where the model is too
            uncertain, or because it is in ``fallen``. It is paid once for each step up to the time limit.
        q, elapsed, phase: coordinates (N, C), numbers of steps in the episode (N,), and phases (N,) of all lanes;
            updated. A phase says whether a lane was never reset, is in an episode, or has ended one.
        rewards: (2, N) array for the rewards less penalties, and the rewards without penalties.
        ends: (5, N) array for five flags of each lane: terminated; truncated; truncated because the model is too
            uncertain; terminated or truncated; ended early with the outside reward.

    Returns:
        The number of lanes whose episode ended.
    """
    row = count = 0
    for n in range(len(moving)):
        for k in range(len(ends)):
            ends[k, n] = False
        rewards[0, n] = rewards[1, n] = 0.0
        if not moving[n]:
            continue
        mean = pay[row] + terminal_reward if over[row] else pay[row]
        doubtful = trust < np.inf and _exceeds(std[row], trust, scales)
        left = len(inside) > 0 and (doubtful or _is_outside(q_next[row], inside))
        left = not over[row] and (left or (len(fallen) > 0 and fallen[row]))
        rewards[1, n] = mean
        rewards[0, n] = mean if penalty == 0 else mean - penalty * std[row, -1]
        if left:
            lacking = max(time_limit - elapsed[n], 1) if time_limit >= 0 else 1
            rewards[0, n] = rewards[1, n] = outside_reward * lacking
        elapsed[n] += 1
        late = time_limit >= 0 and elapsed[n] >= time_limit
        terminated = over[row] or left
        ends[0, n], ends[1, n], ends[2, n], ends[4, n] = terminated, late or doubtful, doubtful, left
        ends[3, n] = ended = terminated or late or doubtful
        phase[n] = ENDED if ended else RUNNING
        count += ended
        for c in range(q.shape[1]):
            q[n, c] = q_next[row, c]
        row += 1
    return count
