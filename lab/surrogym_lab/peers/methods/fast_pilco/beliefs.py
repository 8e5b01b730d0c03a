"""Beliefs over the coordinates along an imagined episode, and what they pass back to the policy, in compiled code.

A belief grows within a step: coordinates, their sines and cosines, the wanted controls, the squashed ones, and the
changes of the coordinates (equations 9 to 11 of the paper). All of it is stored for the way back.

Shapes: H steps, K beliefs, C coordinates, G angles, A features, F controls, B basis functions, n samples, I = A + F
inputs of the model, P pairs of coordinates, V = 2 C + 2 G + 2 F variables.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg.cython_blas  # noqa: F401  # numba calls it
from numba import types

from surrogym_lab.peers.methods.fast_pilco.angles import angles, angles_back, squashed, squashed_back
from surrogym_lab.peers.methods.fast_pilco.processes import (
    Ints,
    free_pair_back,
    logs,
    mean_and_gain,
    mean_and_gain_back,
    pair,
)
from surrogym_sampler.original.protocol import Array
from surrogym_shared.compiled.jit import compiled, entry

Exact = tuple[Array, Array, Array, Array]
"""Samples (n, I), length scales (E, I), signals (E,) and weights (E, n) of processes."""

PLACES, VECTOR = types.int64[::1], types.float64[::1]
ROWS, BLOCKS, FOURFOLD = types.float64[:, ::1], types.float64[:, :, ::1], types.float64[:, :, :, ::1]
PROCESSES = types.Tuple((ROWS, ROWS, VECTOR, ROWS))  # type: ignore[no-untyped-call]


@compiled
def of(covariance: Array, at: Ints) -> Array:
    found = np.empty((at.size, at.size))
    for i in range(at.size):
        for j in range(at.size):
            found[i, j] = covariance[at[i], at[j]]
    return found


@compiled
def append(joint: Array, covariance: Array, first: int, at: Ints, mean: Array, of_mean: Array, gain: Array) -> None:
    """Append outputs, with mean (E,), covariance ``of_mean`` (E, E) and gain, of a function of the variables ``at``, to
    a belief over the ``first`` variables."""
    size = mean.size
    joint[first : first + size] = mean
    for e in range(size):
        for v in range(first):
            cross = 0.0
            for i in range(at.size):
                cross += covariance[v, at[i]] * gain[i, e]
            covariance[v, first + e], covariance[first + e, v] = cross, cross
        for f in range(size):
            covariance[first + e, first + f] = of_mean[e, f]


@compiled
def append_back(
    covariance: Array, by_covariance: Array, first: int, at: Ints, gain: Array, by_gain: Array, by_of_mean: Array
) -> None:
    """Write what the appended outputs' gain and covariance get, and add what the other variables' covariance gets."""
    for e in range(gain.shape[1]):
        for i in range(at.size):
            by_gain[i, e] = 0.0
        for v in range(first):
            by_cross = by_covariance[v, first + e] + by_covariance[first + e, v]
            for i in range(at.size):
                by_gain[i, e] += covariance[v, at[i]] * by_cross
                by_covariance[v, at[i]] += by_cross * gain[i, e]
        for f in range(gain.shape[1]):
            by_of_mean[e, f] = by_covariance[first + e, first + f]


@compiled
def add_at(by_joint: Array, by_covariance: Array, at: Ints, by_mean: Array, by_own: Array) -> None:
    for i in range(at.size):
        by_joint[at[i]] += by_mean[i]
        for j in range(at.size):
            by_covariance[at[i], at[j]] += by_own[i, j]


@compiled
def control(policy: Exact, mean: Array, covariance: Array) -> tuple[Array, Array, Array]:
    """Mean (F,), covariance (F, F) and gain (A, F) of wanted controls, means of processes that are taken for exact."""
    x, length, signal, weights = policy
    size, slope = signal.size, np.empty(mean.size * (mean.size + 1))
    found, gain, of_found = np.empty(size), np.empty((mean.size, size)), np.empty((size, size))
    nu, room, bits = x - mean, np.empty((2, len(x), len(x))), np.empty(len(x), dtype=np.int64)
    mean_and_gain(nu, length, signal, weights, covariance, found, gain)
    for a in range(size):
        for b in range(a, size):
            precision, other = 1 / length[a] ** 2, 1 / length[b] ** 2
            alpha, log_a = logs(nu, precision, signal[a])
            beta, log_b = logs(nu, other, signal[b])
            by = np.outer(weights[a], weights[b])
            moment = pair(alpha, beta, log_a, log_b, by, precision, other, covariance, room, bits, slope)
            of_found[a, b] = moment - found[a] * found[b]
            of_found[b, a] = of_found[a, b]
    return found, of_found, gain


@compiled
def control_back(
    policy: Exact,
    mean: Array,
    covariance: Array,
    found: Array,
    by_found: Array,
    by_of_found: Array,
    by_gain: Array,
    by_policy: tuple[Array, Array, Array],
) -> tuple[Array, Array]:
    """Add what centres, length scales and weights get. Returns what the inputs' mean (A,) and covariance get."""
    x, length, signal, weights = policy
    by_x, by_length, by_weights = by_policy
    nu, room, bits = x - mean, np.empty((2, len(x), len(x))), np.empty(len(x), dtype=np.int64)
    by_nu, by_covariance, by = np.zeros_like(nu), np.zeros_like(covariance), by_found.copy()
    for a in range(signal.size):
        for b in range(signal.size):
            by[a] -= (by_of_found[a, b] + by_of_found[b, a]) * found[b]
        for b in range(a, signal.size):
            own = by_of_found[a, b] + (by_of_found[b, a] if b > a else 0.0)
            free_pair_back(
                nu,
                a,
                b,
                length,
                signal,
                weights,
                covariance,
                own,
                by_nu,
                by_length,
                by_weights,
                by_covariance,
                room,
                bits,
            )
    mean_and_gain_back(
        nu, length, signal, weights, covariance, by, by_gain, by_nu, by_length, by_weights, by_covariance, False
    )
    by_mean = np.zeros(mean.size)
    for n in range(len(nu)):
        for i in range(mean.size):
            by_x[n, i] += by_nu[n, i]
            by_mean[i] -= by_nu[n, i]
    return by_mean, by_covariance


@compiled
def change(
    model: Exact, by_pairs: Array, mean: Array, covariance: Array, room: Array, bits: Ints, slopes: Array
) -> tuple[Array, Array, Array]:
    """Mean (C,), covariance (C, C) and gain (I, C) of the model's outputs. ``slopes`` (P, I + I^2) gets the derivatives
    of the second moments."""
    x, length, signal, weights = model
    size, at = signal.size, 0
    found, gain, of_found = np.empty(size), np.empty((mean.size, size)), np.empty((size, size))
    nu = x - mean
    mean_and_gain(nu, length, signal, weights, covariance, found, gain)
    for a in range(size):
        precision = 1 / length[a] ** 2
        alpha, log_a = logs(nu, precision, signal[a])
        for b in range(a, size):
            other = 1 / length[b] ** 2
            beta, log_b = logs(nu, other, signal[b])
            moment = pair(alpha, beta, log_a, log_b, by_pairs[at], precision, other, covariance, room, bits, slopes[at])
            of_found[a, b] = moment - found[a] * found[b] + (signal[a] ** 2 if a == b else 0.0)
            of_found[b, a] = of_found[a, b]
            at += 1
    return found, of_found, gain


@compiled
def change_back(
    model: Exact,
    mean: Array,
    covariance: Array,
    found: Array,
    slopes: Array,
    by_found: Array,
    by_of_found: Array,
    by_gain: Array,
) -> tuple[Array, Array]:
    """Return what the inputs' mean (I,) and covariance (I, I) get."""
    x, length, signal, weights = model
    size, inputs, at = signal.size, mean.size, 0
    nu, by, by_mean, by_covariance = x - mean, by_found.copy(), np.zeros(mean.size), np.zeros_like(covariance)
    by_nu, none = np.zeros_like(nu), np.empty((0, 0))
    for a in range(size):
        for b in range(size):
            by[a] -= (by_of_found[a, b] + by_of_found[b, a]) * found[b]
        for b in range(a, size):
            own = by_of_found[a, b] + (by_of_found[b, a] if b > a else 0.0)
            for i in range(inputs):
                by_mean[i] += own * slopes[at, i]
                for j in range(inputs):
                    by_covariance[i, j] += own * slopes[at, inputs + i * inputs + j]
            at += 1
    mean_and_gain_back(nu, length, signal, weights, covariance, by, by_gain, by_nu, none, none, by_covariance, True)
    for n in range(len(nu)):
        for i in range(inputs):
            by_mean[i] -= by_nu[n, i]
    return by_mean, by_covariance


@compiled
def ahead(
    model: Exact,
    by_pairs: Array,
    policy: Exact,
    places: tuple[Ints, Ints, Ints, Ints, Ints],
    room: Array,
    bits: Ints,
    joint: Array,
    covariance: Array,
    slopes: Array,
) -> None:
    """Complete a belief whose coordinates are written."""
    turning, features, wanted, inputs, _ = places
    size, controls = len(model[2]), len(policy[2])
    count = 2 * turning.size
    mean, own, gain = np.empty(count), np.empty((count, count)), np.empty((turning.size, count))
    angles(joint[turning], of(covariance, turning), mean, own, gain)
    append(joint, covariance, size, turning, mean, own, gain)
    mean, own, gain = control(policy, joint[features], of(covariance, features))
    append(joint, covariance, size + count, features, mean, own, gain)
    mean, own, gain = np.empty(controls), np.empty((controls, controls)), np.empty((controls, controls))
    squashed(joint[wanted], of(covariance, wanted), mean, own, gain)
    append(joint, covariance, size + count + controls, wanted, mean, own, gain)
    mean, own, gain = change(model, by_pairs, joint[inputs], of(covariance, inputs), room, bits, slopes)
    append(joint, covariance, size + count + 2 * controls, inputs, mean, own, gain)


@compiled
def behind(
    model: Exact,
    policy: Exact,
    places: tuple[Ints, Ints, Ints, Ints, Ints],
    joint: Array,
    covariance: Array,
    slopes: Array,
    by_joint: Array,
    by_covariance: Array,
    by_policy: tuple[Array, Array, Array],
) -> None:
    """Pass a belief's derivatives back to its coordinates, and to the policy."""
    turning, features, wanted, inputs, changes = places
    size, controls, count = len(model[2]), len(policy[2]), 2 * turning.size
    # the model
    first, x, s = size + count + 2 * controls, joint[inputs], of(covariance, inputs)
    gain, found = np.empty((inputs.size, size)), joint[changes]
    mean_and_gain(model[0] - x, model[1], model[2], model[3], s, np.empty(size), gain)
    by_gain, by_own = np.empty_like(gain), np.empty((size, size))
    append_back(covariance, by_covariance, first, inputs, gain, by_gain, by_own)
    mean, own = change_back(model, x, s, found, slopes, by_joint[changes], by_own, by_gain)
    add_at(by_joint, by_covariance, inputs, mean, own)
    # the squashed controls
    first, x, s = first - controls, joint[wanted], of(covariance, wanted)
    gain, by_gain, by_own = np.empty_like(s), np.empty_like(s), np.empty_like(s)
    squashed(x, s, np.empty(controls), np.empty_like(s), gain)
    append_back(covariance, by_covariance, first, wanted, gain, by_gain, by_own)
    mean, own = np.zeros(controls), np.zeros_like(s)
    squashed_back(x, s, by_joint[first : first + controls], by_own, by_gain, mean, own)
    add_at(by_joint, by_covariance, wanted, mean, own)
    # the wanted controls
    first, x, s = first - controls, joint[features], of(covariance, features)
    gain, by_own = np.empty((features.size, controls)), np.empty((controls, controls))
    found = joint[wanted]
    mean_and_gain(policy[0] - x, policy[1], policy[2], policy[3], s, np.empty(controls), gain)
    by_gain = np.empty_like(gain)
    append_back(covariance, by_covariance, first, features, gain, by_gain, by_own)
    mean, own = control_back(policy, x, s, found, by_joint[wanted], by_own, by_gain, by_policy)
    add_at(by_joint, by_covariance, features, mean, own)
    # sines and cosines
    first, x, s = size, joint[turning], of(covariance, turning)
    found, own, gain = np.empty(count), np.empty((count, count)), np.empty((turning.size, count))
    angles(x, s, found, own, gain)
    by_gain, by_own = np.empty_like(gain), np.empty((count, count))
    append_back(covariance, by_covariance, first, turning, gain, by_gain, by_own)
    mean, own = np.zeros(turning.size), np.zeros_like(s)
    angles_back(x, s, found, by_joint[first : first + count], by_own, by_gain, mean, own)
    add_at(by_joint, by_covariance, turning, mean, own)


FIVE, THREE = types.UniTuple(PLACES, 5), types.UniTuple(ROWS, 3)  # type: ignore[no-untyped-call]


@entry(PROCESSES, BLOCKS, PROCESSES, FIVE, BLOCKS, FOURFOLD, FOURFOLD, BLOCKS, FOURFOLD)
def forward(
    model: Exact,
    by_pairs: Array,
    policy: Exact,
    places: tuple[Ints, Ints, Ints, Ints, Ints],
    joints: Array,
    covariances: Array,
    slopes: Array,
    means: Array,
    own: Array,
) -> None:
    """Write the beliefs of an episode.

    Args:
        model: of changes of coordinates.
        by_pairs: (P, n, n), products of weights of two outputs, less the inverse covariances for the same one.
        policy: of wanted controls.
        places: of angles, features, wanted controls, inputs of the model, and changes among the variables.
        joints, covariances, slopes: (H, K, V), (H, K, V, V), (H, K, P, I + I^2), for the way back.
        means, own: (H + 1, K, C) and (H + 1, K, C, C), beliefs over the coordinates; the first is given.
    """
    n, size, changes = len(model[0]), means.shape[2], places[4]
    room, bits = np.empty((2, n, n)), np.empty(n, dtype=np.int64)
    for step in range(len(joints)):
        for k in range(joints.shape[1]):
            joint, covariance = joints[step, k], covariances[step, k]
            joint[:size], covariance[:size, :size] = means[step, k], own[step, k]
            ahead(model, by_pairs, policy, places, room, bits, joint, covariance, slopes[step, k])
            for i in range(size):
                means[step + 1, k, i] = joint[i] + joint[changes[i]]
                for j in range(size):
                    cross = covariance[i, changes[j]] + covariance[j, changes[i]]
                    own[step + 1, k, i, j] = covariance[i, j] + cross + covariance[changes[i], changes[j]]


@entry(PROCESSES, PROCESSES, FIVE, BLOCKS, FOURFOLD, FOURFOLD, BLOCKS, FOURFOLD, THREE)
def backward(
    model: Exact,
    policy: Exact,
    places: tuple[Ints, Ints, Ints, Ints, Ints],
    joints: Array,
    covariances: Array,
    slopes: Array,
    by_means: Array,
    by_own: Array,
    by_policy: tuple[Array, Array, Array],
) -> None:
    """Add what the policy's centres (B, A), length scales (F, A) and weights (F, B) get from derivatives by the beliefs
    over the coordinates, which are overwritten."""
    size, variables, changes = by_means.shape[2], joints.shape[2], places[4]
    for step in range(len(joints) - 1, -1, -1):
        for k in range(joints.shape[1]):
            by_joint, by_covariance = np.zeros(variables), np.zeros((variables, variables))
            for i in range(size):
                by_joint[i] = by_means[step + 1, k, i]
                by_joint[changes[i]] = by_means[step + 1, k, i]
                for j in range(size):
                    by = by_own[step + 1, k, i, j]
                    by_covariance[i, j] += by
                    by_covariance[i, changes[j]] += by
                    by_covariance[j, changes[i]] += by
                    by_covariance[changes[i], changes[j]] += by
            behind(
                model,
                policy,
                places,
                joints[step, k],
                covariances[step, k],
                slopes[step, k],
                by_joint,
                by_covariance,
                by_policy,
            )
            for i in range(size):
                by_means[step, k, i] += by_joint[i]
                for j in range(size):
                    by_own[step, k, i, j] += by_covariance[i, j]
