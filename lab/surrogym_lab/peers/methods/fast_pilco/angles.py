"""Moments of sines, cosines and squashed controls, and what they pass back, in compiled code.

``back`` functions add the derivatives of a number by their inputs, given its derivatives by their outputs
(``by_...``). Covariances are full matrices; derivatives by a symmetric one need not be symmetric.

Shapes: G angles, F controls.
"""

from __future__ import annotations

import math

import numpy as np

from surrogym_sampler.original.protocol import Array
from surrogym_shared.compiled.jit import compiled

ONE, THREE = 9 / 8, 1 / 8  # weights of sin(v) and sin(3 v) in a squashed control


@compiled
def angles(mean: Array, covariance: Array, of_mean: Array, of_covariance: Array, gain: Array) -> None:
    """Write the moments of the sines, then the cosines of angles: mean (2 G,), covariance (2 G, 2 G) and gain
    (G, 2 G)."""
    size = len(mean)
    gain[:] = 0.0
    for i in range(size):
        shrink = math.exp(-covariance[i, i] / 2)
        of_mean[i], of_mean[size + i] = shrink * math.sin(mean[i]), shrink * math.cos(mean[i])
        gain[i, i], gain[i, size + i] = of_mean[size + i], -of_mean[i]
    for i in range(size):
        for j in range(size):
            total = (covariance[i, i] + covariance[j, j]) / 2
            less, more = math.exp(covariance[i, j] - total) / 2, math.exp(-covariance[i, j] - total) / 2
            minus, plus = mean[i] - mean[j], mean[i] + mean[j]
            of_covariance[i, j] = less * math.cos(minus) - more * math.cos(plus)
            of_covariance[size + i, size + j] = less * math.cos(minus) + more * math.cos(plus)
            of_covariance[i, size + j] = less * math.sin(minus) + more * math.sin(plus)
            of_covariance[size + j, i] = of_covariance[i, size + j]
    for i in range(2 * size):
        for j in range(2 * size):
            of_covariance[i, j] -= of_mean[i] * of_mean[j]


@compiled
def angles_back(
    mean: Array,
    covariance: Array,
    of_mean: Array,
    by_of_mean: Array,
    by_of_covariance: Array,
    by_gain: Array,
    by_mean: Array,
    by_covariance: Array,
) -> None:
    size = len(mean)
    by = by_of_mean.copy()
    for i in range(2 * size):
        for j in range(2 * size):
            by[i] -= (by_of_covariance[i, j] + by_of_covariance[j, i]) * of_mean[j]
    for i in range(size):
        sine, cosine = by[i] - by_gain[i, size + i], by[size + i] + by_gain[i, i]
        by_mean[i] += sine * of_mean[size + i] - cosine * of_mean[i]
        by_covariance[i, i] -= (sine * of_mean[i] + cosine * of_mean[size + i]) / 2
    for i in range(size):
        for j in range(size):
            by_sines, by_cosines = by_of_covariance[i, j], by_of_covariance[size + i, size + j]
            by_mixed = by_of_covariance[i, size + j] + by_of_covariance[size + j, i]
            total = (covariance[i, i] + covariance[j, j]) / 2
            less, more = math.exp(covariance[i, j] - total) / 2, math.exp(-covariance[i, j] - total) / 2
            minus, plus = mean[i] - mean[j], mean[i] + mean[j]
            by_less = less * ((by_sines + by_cosines) * math.cos(minus) + by_mixed * math.sin(minus))
            by_more = more * ((by_cosines - by_sines) * math.cos(plus) + by_mixed * math.sin(plus))
            by_minus = less * (by_mixed * math.cos(minus) - (by_sines + by_cosines) * math.sin(minus))
            by_plus = more * (by_mixed * math.cos(plus) - (by_cosines - by_sines) * math.sin(plus))
            by_mean[i] += by_plus + by_minus
            by_mean[j] += by_plus - by_minus
            by_covariance[i, j] += by_less - by_more
            by_covariance[i, i] -= (by_less + by_more) / 2
            by_covariance[j, j] -= (by_less + by_more) / 2


@compiled
def tripled(mean: Array, covariance: Array, twice: Array, of_twice: Array) -> None:
    """Write mean (2 F,) and covariance (2 F, 2 F) of v and 3 v."""
    size = len(mean)
    for i in range(2 * size):
        factor = 1.0 if i < size else 3.0
        twice[i] = factor * mean[i % size]
        for j in range(2 * size):
            of_twice[i, j] = factor * (1.0 if j < size else 3.0) * covariance[i % size, j % size]


@compiled
def squashed(mean: Array, covariance: Array, of_mean: Array, of_covariance: Array, gain: Array) -> None:
    """Write the moments of 9/8 sin(v) + 1/8 sin(3 v) of controls (F,)."""
    size = len(mean)
    twice, of_twice = np.empty(2 * size), np.empty((2 * size, 2 * size))
    tripled(mean, covariance, twice, of_twice)
    sines, of_sines, through = np.empty(4 * size), np.empty((4 * size, 4 * size)), np.empty((2 * size, 4 * size))
    angles(twice, of_twice, sines, of_sines, through)
    of_mean[:], of_covariance[:], gain[:] = 0.0, 0.0, 0.0
    for i in range(2 * size):
        weight, factor = (ONE, 1.0) if i < size else (THREE, 3.0)
        of_mean[i % size] += weight * sines[i]
        for j in range(2 * size):
            other = ONE if j < size else THREE
            of_covariance[i % size, j % size] += weight * other * of_sines[i, j]
            gain[i % size, j % size] += factor * other * through[i, j]


@compiled
def squashed_back(
    mean: Array,
    covariance: Array,
    by_of_mean: Array,
    by_of_covariance: Array,
    by_gain: Array,
    by_mean: Array,
    by_covariance: Array,
) -> None:
    size = len(mean)
    twice, of_twice = np.empty(2 * size), np.empty((2 * size, 2 * size))
    tripled(mean, covariance, twice, of_twice)
    sines, of_sines, through = np.empty(4 * size), np.empty((4 * size, 4 * size)), np.empty((2 * size, 4 * size))
    angles(twice, of_twice, sines, of_sines, through)
    by_sines, by_of_sines, by_through = np.zeros_like(sines), np.zeros_like(of_sines), np.zeros_like(through)
    for i in range(2 * size):
        weight, factor = (ONE, 1.0) if i < size else (THREE, 3.0)
        by_sines[i] = weight * by_of_mean[i % size]
        for j in range(2 * size):
            other = ONE if j < size else THREE
            by_of_sines[i, j] = weight * other * by_of_covariance[i % size, j % size]
            by_through[i, j] = factor * other * by_gain[i % size, j % size]
    by_twice, by_of_twice = np.zeros(2 * size), np.zeros((2 * size, 2 * size))
    angles_back(twice, of_twice, sines, by_sines, by_of_sines, by_through, by_twice, by_of_twice)
    for i in range(2 * size):
        factor = 1.0 if i < size else 3.0
        by_mean[i % size] += factor * by_twice[i]
        for j in range(2 * size):
            by_covariance[i % size, j % size] += factor * (1.0 if j < size else 3.0) * by_of_twice[i, j]
