"""Moments of Gaussian processes at uncertain inputs, and what they pass back, in compiled code.

The derivatives of a second moment by the inputs' mean and covariance need the same sums over pairs of samples as the
moment itself. So the model's are computed with it (``pair``), as in PILCO's authors' program, and stored.

Shapes: I inputs, E outputs, n samples.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from surrogym_sampler.original.protocol import Array
from surrogym_shared.compiled.jit import compiled, summing

Ints = NDArray[np.int64]

LOG2E, LN2_HIGH, LN2_LOW = 1.4426950408889634, 0.6931471803691238, 1.9082149292705877e-10
MAGIC = 6755399441055744.0  # 1.5 * 2^52; a sum with it has the nearest whole number in its last bits
LOWEST, HIGHEST = -708.0, 708.0  # exponents beyond are cut off
BIAS, SHIFT = 1023, 52  # of a double's exponent


@compiled
def exponentials(x: Array, y: Array, powers: Array, bits: Ints) -> None:
    """Write e^x (n,) to y, to about one unit in the last place. ``powers`` and ``bits`` (integers) are the same
    memory, and are overwritten."""
    for i in range(x.size):
        at = min(max(x[i], LOWEST), HIGHEST)
        shifted = at * LOG2E + MAGIC
        powers[i] = shifted
        whole = shifted - MAGIC
        r = (at - whole * LN2_HIGH) - whole * LN2_LOW
        p = 1.0 / 6227020800.0
        p = p * r + 1.0 / 479001600.0
        p = p * r + 1.0 / 39916800.0
        p = p * r + 1.0 / 3628800.0
        p = p * r + 1.0 / 362880.0
        p = p * r + 1.0 / 40320.0
        p = p * r + 1.0 / 5040.0
        p = p * r + 1.0 / 720.0
        p = p * r + 1.0 / 120.0
        p = p * r + 1.0 / 24.0
        p = p * r + 1.0 / 6.0
        p = p * r + 0.5
        p = p * r + 1.0
        y[i] = p * r + 1.0
    for i in range(x.size):
        bits[i] = (bits[i] + BIAS) << SHIFT
    for i in range(x.size):
        y[i] *= powers[i]


@compiled
def inverse(matrix: Array) -> tuple[Array, float]:
    """Inverse (I, I) and determinant of a symmetric matrix with positive eigenvalues, by Cholesky's method. Others give
    NaN."""
    size = len(matrix)
    factor, root, found, determinant = np.zeros((size, size)), np.zeros((size, size)), np.empty((size, size)), 1.0
    for i in range(size):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            factor[i, j] = math.sqrt(total) if i == j else total / factor[j, j]
        determinant *= factor[i, i] ** 2
    for j in range(size):
        root[j, j] = 1 / factor[j, j]
        for i in range(j + 1, size):
            total = 0.0
            for k in range(j, i):
                total -= factor[i, k] * root[k, j]
            root[i, j] = total / factor[i, i]
    for i in range(size):
        for j in range(i + 1):
            total = 0.0
            for k in range(i, size):
                total += root[k, i] * root[k, j]
            found[i, j], found[j, i] = total, total
    return found, determinant


@compiled
def product(a: Array, b: Array) -> Array:
    """The product of two small matrices."""
    found = np.zeros((a.shape[0], b.shape[1]))
    for i in range(a.shape[0]):
        for k in range(a.shape[1]):
            for j in range(b.shape[1]):
                found[i, j] += a[i, k] * b[k, j]
    return found


@summing
def dot(a: Array, b: Array) -> float:
    total = 0.0
    for i in range(a.size):
        total += a[i] * b[i]
    return total


@compiled
def one(
    nu: Array, length: Array, signal: float, weights: Array, covariance: Array
) -> tuple[Array, Array, float, Array, Array]:
    """Of one output: the inverse of covariance + length^2 (I, I), the contributions h (n,) of samples to its mean,
    the factor of all, sum h nu (I,), and the samples' z = inverse nu (n, I). Equations 14 to 16."""
    size = len(length)
    sum_of = covariance.copy()
    scale = signal**2
    for i in range(size):
        sum_of[i, i] += length[i] ** 2
        scale *= length[i]
    w, determinant = inverse(sum_of)
    scale /= math.sqrt(determinant)
    h, z, total = np.empty(len(nu)), product(nu, w), np.zeros(size)
    for n in range(len(nu)):
        h[n] = scale * weights[n] * math.exp(-dot(nu[n], z[n]) / 2)
        for i in range(size):
            total[i] += h[n] * nu[n, i]
    return w, h, scale, total, z


@compiled
def mean_and_gain(
    nu: Array, length: Array, signal: Array, weights: Array, covariance: Array, mean: Array, gain: Array
) -> None:
    """Write means (E,) and gains (I, E). ``nu`` (n, I): samples minus the inputs' mean."""
    for e in range(len(signal)):
        w, h, _, total, _ = one(nu, length[e], signal[e], weights[e], covariance)
        mean[e] = h.sum()
        for i in range(len(total)):
            gain[i, e] = dot(w[i], total)


@compiled
def mean_and_gain_back(
    nu: Array,
    length: Array,
    signal: Array,
    weights: Array,
    covariance: Array,
    by_mean: Array,
    by_gain: Array,
    by_nu: Array,
    by_length: Array,
    by_weights: Array,
    by_covariance: Array,
    fixed: bool,
) -> None:
    """``fixed`` omits length scales and weights. The derivative by the inputs' mean is minus the sum of ``by_nu``."""
    size = nu.shape[1]
    for e in range(len(signal)):
        w, h, scale, total, z = one(nu, length[e], signal[e], weights[e], covariance)
        by_total, of_e = np.empty(size), np.ascontiguousarray(by_gain[:, e])
        for i in range(size):
            by_total[i] = dot(w[i], of_e)
        by_w, by_scale = np.zeros((size, size)), 0.0
        for n in range(len(nu)):
            by_h = by_mean[e] + dot(by_total, nu[n])
            by_exponent = by_h * h[n]
            by_scale += by_exponent
            if not fixed:
                by_weights[e, n] += by_h * scale * math.exp(-dot(nu[n], z[n]) / 2)
            for i in range(size):
                by_nu[n, i] += h[n] * by_total[i] - by_exponent * z[n, i]
                for j in range(size):
                    by_w[i, j] -= by_exponent * nu[n, i] * nu[n, j] / 2
        for i in range(size):
            for j in range(size):
                by_w[i, j] += (of_e[i] * total[j] + of_e[j] * total[i]) / 2
        by_sum = product(product(w, by_w), w)
        for i in range(size):
            for j in range(size):
                by_sum[i, j] = -by_sum[i, j] - by_scale * w[i, j] / 2
                by_covariance[i, j] += by_sum[i, j]
            if not fixed:
                by_length[e, i] += 2 * length[e, i] * by_sum[i, i] + by_scale / length[e, i]


@compiled
def shared(precision: Array, other: Array, covariance: Array) -> tuple[Array, Array, float]:
    """Of a pair of outputs: R^-1 and Q = R^-1 covariance (I, I), and the root of det R, R = covariance C + 1, C the sum
    of both precisions (I,)."""
    size = len(precision)
    root, matrix = np.sqrt(precision + other), np.empty((size, size))
    for i in range(size):
        for j in range(size):
            matrix[i, j] = root[i] * covariance[i, j] * root[j]
        matrix[i, i] += 1
    found, determinant = inverse(matrix)
    for i in range(size):
        for j in range(size):
            found[i, j] *= root[j] / root[i]
    q = product(found, covariance)
    return found, (q + q.T) / 2, math.sqrt(determinant)


@compiled
def products(
    alpha: Array, beta: Array, log_a: Array, log_b: Array, q: Array, exponents: Array, found: Array, bits: Ints
) -> None:
    """Write e to (log_a + log_b + (alpha + beta)' Q (alpha + beta) / 2) of each pair of samples (n, n)."""
    turned = product(alpha, q)
    np.dot(turned, beta.T, exponents)
    of_b = np.empty(len(beta))
    again = product(beta, q)
    for n in range(len(beta)):
        of_b[n] = log_b[n] + dot(again[n], beta[n]) / 2
    powers = bits.view(np.float64)
    for n in range(len(alpha)):
        of_a, row = log_a[n] + dot(turned[n], alpha[n]) / 2, exponents[n]
        for m in range(row.size):
            row[m] += of_a + of_b[m]
        exponentials(row, found[n], powers, bits)


@compiled
def pair(
    alpha: Array,
    beta: Array,
    log_a: Array,
    log_b: Array,
    by: Array,
    precision: Array,
    other: Array,
    covariance: Array,
    room: Array,
    bits: Ints,
    slope: Array,
) -> float:
    """Return sum of ``by`` (n, n) times the means of products of two kernels, equations 18, 22 and 23.

    Its derivatives by the inputs' mean (I,), then by their covariance (I, I) are written to ``slope``.

    Args:
        alpha, beta: (n, I), nu times the precision of the one and the other output.
        log_a, log_b: (n,), logarithms of the kernels at the inputs' mean.
        room: (2, n, n), overwritten; ``bits``: (n,).
    """
    n, size = alpha.shape
    inverted, q, root = shared(precision, other, covariance)
    exponents, found = room[0], room[1]
    products(alpha, beta, log_a, log_b, q, exponents, found, bits)
    columns = np.zeros(n)
    rows = np.empty(n)
    for i in range(n):
        line, weight = found[i], by[i]
        for j in range(n):
            line[j] *= weight[j]
        for j in range(n):
            columns[j] += line[j]
        rows[i] = total_of(line)
    value: float = rows.sum() / root
    mixed = np.dot(found, beta)  # (n, I)
    by_q, along = np.zeros((size, size)), np.zeros(size)
    for i in range(n):
        for a in range(size):
            along[a] += rows[i] * alpha[i, a] + columns[i] * beta[i, a]
            for b in range(size):
                both = alpha[i, a] * mixed[i, b] + alpha[i, b] * mixed[i, a]
                by_q[a, b] += (rows[i] * alpha[i, a] * alpha[i, b] + columns[i] * beta[i, a] * beta[i, b] + both) / 2
    by_covariance = product(product(inverted.T, by_q), inverted)
    for a in range(size):
        total = 0.0
        for b in range(size):
            total += inverted[b, a] * along[b]
            c = precision[a] + other[a]
            slope[size + a * size + b] = by_covariance[a, b] / root - value * c * inverted[a, b] / 2
        slope[a] = total / root
    return value


@summing
def total_of(x: Array) -> float:
    total = 0.0
    for i in range(x.size):
        total += x[i]
    return total


@compiled
def logs(nu: Array, precision: Array, signal: float) -> tuple[Array, Array]:
    """nu times the precision (n, I), and the logarithms (n,) of the kernel at the inputs' mean."""
    scaled, found = nu * precision, np.empty(len(nu))
    for n in range(len(nu)):
        found[n] = 2 * math.log(signal) - dot(nu[n], scaled[n]) / 2
    return scaled, found


@compiled
def free_pair_back(
    nu: Array,
    a: int,
    b: int,
    length: Array,
    signal: Array,
    weights: Array,
    covariance: Array,
    by: float,
    by_nu: Array,
    by_length: Array,
    by_weights: Array,
    by_covariance: Array,
    room: Array,
    bits: Ints,
) -> None:
    """Pass back the derivative ``by`` of the second moment of outputs a and b of certain functions, to samples, length
    scales and weights too."""
    n, size = nu.shape
    precision, other = 1 / length[a] ** 2, 1 / length[b] ** 2
    alpha, log_a = logs(nu, precision, signal[a])
    beta, log_b = logs(nu, other, signal[b])
    inverted, q, root = shared(precision, other, covariance)
    exponents, found = room[0], room[1]
    products(alpha, beta, log_a, log_b, q, exponents, found, bits)
    of_a, of_b = np.zeros(n), np.zeros(n)
    from_b, from_a = np.zeros((n, size)), np.zeros((n, size))  # G beta without w_a, G' alpha without w_b
    for i in range(n):
        for j in range(n):
            value = by / root * found[i, j]
            of_a[i] += value * weights[b, j]
            of_b[j] += value * weights[a, i]
            for k in range(size):
                from_b[i, k] += value * weights[b, j] * beta[j, k]
                from_a[j, k] += value * weights[a, i] * alpha[i, k]
    total, by_q = 0.0, np.zeros((size, size))
    by_a, by_b = np.zeros(size), np.zeros(size)  # by the precisions
    for i in range(n):
        rows, columns = weights[a, i] * of_a[i], weights[b, i] * of_b[i]
        total += rows
        by_weights[a, i] += of_a[i]
        by_weights[b, i] += of_b[i]
        for k in range(size):
            by_alpha, by_beta = 0.0, 0.0
            for m in range(size):
                left, right = weights[a, i] * from_b[i, m], weights[b, i] * from_a[i, m]
                by_alpha += q[k, m] * (rows * alpha[i, m] + left)
                by_beta += q[k, m] * (columns * beta[i, m] + right)
                both = alpha[i, k] * left + alpha[i, m] * weights[a, i] * from_b[i, k]
                by_q[k, m] += (rows * alpha[i, k] * alpha[i, m] + columns * beta[i, k] * beta[i, m] + both) / 2
            by_nu[i, k] += precision[k] * by_alpha - rows * alpha[i, k] + other[k] * by_beta - columns * beta[i, k]
            by_a[k] += nu[i, k] * by_alpha - rows * nu[i, k] ** 2 / 2
            by_b[k] += nu[i, k] * by_beta - columns * nu[i, k] ** 2 / 2
    by_sum, passed = product(product(q, by_q), q), product(product(inverted.T, by_q), inverted)
    for k in range(size):
        both = -by_sum[k, k] - total * q[k, k] / 2
        by_length[a, k] -= 2 * (by_a[k] + both) / length[a, k] ** 3
        by_length[b, k] -= 2 * (by_b[k] + both) / length[b, k] ** 3
        for m in range(size):
            by_covariance[k, m] += passed[k, m] - total * (precision[k] + other[k]) * inverted[k, m] / 2
