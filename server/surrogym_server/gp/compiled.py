"""One process in compiled code: mean and latent deviation of a block of inputs, (d, B), one column each.

All exponents are taken by differences, which here cost no more than products (see ``gp.serving``, the reference).
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from surrogym_server.compiled.elementary import exponential
from surrogym_server.compiled.jit import compiled, inlined
from surrogym_server.compiled.tables import TablesBuilder, matrix
from surrogym_server.gp.kernel import to_mirror
from surrogym_server.gp.posterior import Posterior

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# Places of a process' matrices: its numbers (below); columns of x and inverse length scales (2, d); points in length
# scales (n, d), then their mirror images; weights of them (1, S); coefficients of x, x^2 and of the prior variance's
# x^2, x^4, of the mirror's exponent, and of the polynomial covariances with points (5 + 2 n, d); L (n, n).
HEAD, INPUTS, POINTS, WEIGHTS, POLYNOMIALS, FACTOR = range(6)
# Scale, constants of mean and prior variance, parity of a reflection or 0, signal variance, constant of the polynomial
# covariance, whether there is any, and the number of points.
SCALE, CENTRE, PRIOR, PARITY, SIGNAL, CONSTANT, POLYNOMIAL, COUNT = range(8)
OF_MEAN, OF_PRIOR, OF_MIRROR, OF_POINTS = 0, 2, 4, 5  # rows of POLYNOMIALS


def add_process(
    tables: TablesBuilder, posterior: Posterior, inputs: tuple[int, ...], centre: float, scale: float
) -> int:
    """Put a process that reads the columns ``inputs`` of x; gives its place. Its output is centre + scale * process."""
    hyper, x, polynomial = posterior.hyper, posterior.x, posterior.hyper.polynomial
    points, weights, mirror = x, posterior.weights, torch.zeros_like(hyper.lengthscale)
    if (reflection := hyper.reflection) is not None:
        points = torch.cat([x, x * reflection.signs])
        weights = torch.cat([weights, reflection.parity * weights])
        mirror = to_mirror(hyper)
    linear, squares = x * polynomial.linear, x.square() * polynomial.quadratic
    variance = hyper.signal_variance + polynomial.constant
    head = (
        scale,
        centre + scale * polynomial.constant * float(posterior.weights.sum()),
        variance,
        0 if reflection is None else reflection.parity,
        hyper.signal_variance,
        polynomial.constant,
        hyper.has_polynomial,
        len(x),
    )
    rows = [
        scale * (posterior.weights @ linear),
        scale * (posterior.weights @ squares),
        polynomial.linear,
        polynomial.quadratic,
        mirror,
    ]
    return tables.add(
        head,
        [inputs, (1 / hyper.lengthscale).tolist()],
        points / hyper.lengthscale,
        scale * hyper.signal_variance * weights,
        torch.cat([torch.stack(rows), linear, squares]),
        posterior.factor,
    )


@inlined
def _smooth(own: Floats, inverse: Floats, points: Floats) -> Floats:
    """exp(-1/2 sum_j (x_j / l_j - X_ij)^2) of inputs (d, B) and points (S, d), (S, B)."""
    size, lanes = own.shape
    scaled = np.empty_like(own)
    for j in range(size):
        for b in range(lanes):
            scaled[j, b] = own[j, b] * inverse[j]
    smooth = np.zeros((len(points), lanes))
    for i in range(len(points)):
        j = 0
        while j + 1 < size:
            for b in range(lanes):
                one, other = scaled[j, b] - points[i, j], scaled[j + 1, b] - points[i, j + 1]
                smooth[i, b] -= 0.5 * (one * one + other * other)
            j += 2
        if j < size:
            for b in range(lanes):
                one = scaled[j, b] - points[i, j]
                smooth[i, b] -= 0.5 * one * one
    exponential(smooth.reshape(smooth.size))
    return smooth


@inlined
def _covariances(head: Floats, rows: Floats, own: Floats, smooth: Floats) -> Floats:
    """Covariances of inputs (d, B) with the points, (n, B)."""
    count, parity, signal = int(head[0, COUNT]), head[0, PARITY], head[0, SIGNAL]
    size, lanes = own.shape
    k = np.empty((count, lanes))
    for i in range(count):
        for b in range(lanes):
            k[i, b] = signal * smooth[i, b]
        if parity != 0:
            for b in range(lanes):
                k[i, b] += parity * signal * smooth[count + i, b]
        if head[0, POLYNOMIAL]:
            for b in range(lanes):
                k[i, b] += head[0, CONSTANT]
            for j in range(size):
                linear, square = rows[OF_POINTS + i, j], rows[OF_POINTS + count + i, j]
                for b in range(lanes):
                    k[i, b] += own[j, b] * (linear + own[j, b] * square)
    return k


@inlined
def _explain(factor: Floats, k: Floats) -> None:
    """L^-1 k in the place of k (n, B)."""
    lanes = k.shape[1]
    for i in range(len(factor)):
        j = 0
        while j + 1 < i:
            one, other = factor[i, j], factor[i, j + 1]
            for b in range(lanes):
                k[i, b] -= one * k[j, b] + other * k[j + 1, b]
            j += 2
        if j < i:
            for b in range(lanes):
                k[i, b] -= factor[i, j] * k[j, b]
        pivot = 1 / factor[i, i]
        for b in range(lanes):
            k[i, b] *= pivot


@inlined
def _deviation(head: Floats, rows: Floats, own: Floats, explained: Floats, deviation: Floats) -> None:
    """sqrt(k(x, x) - |L^-1 k|^2) into (B,)."""
    size, lanes = own.shape
    deviation[:] = 0.0
    if head[0, PARITY] != 0:
        for j in range(size):
            for b in range(lanes):
                deviation[b] += rows[OF_MIRROR, j] * own[j, b] * own[j, b]
        exponential(deviation)
        for b in range(lanes):
            deviation[b] *= head[0, PARITY] * head[0, SIGNAL]
    for b in range(lanes):
        deviation[b] += head[0, PRIOR]
    for j in range(size):
        for b in range(lanes):
            square = own[j, b] * own[j, b]
            deviation[b] += square * (rows[OF_PRIOR, j] + square * rows[OF_PRIOR + 1, j])
    for i in range(len(explained)):
        for b in range(lanes):
            deviation[b] -= explained[i, b] * explained[i, b]
    for b in range(lanes):
        deviation[b] = head[0, SCALE] * np.sqrt(max(deviation[b], 0.0))


@compiled
def predict(numbers: Floats, places: Ints, at: int, x: Floats, wanted: bool, mean: Floats, deviation: Floats) -> None:
    """Mean and, if wanted, latent deviation at inputs x (d, B), in the output's unit: into (B,) each."""
    head, inputs = matrix(numbers, places, at + HEAD), matrix(numbers, places, at + INPUTS)
    points, weights = matrix(numbers, places, at + POINTS), matrix(numbers, places, at + WEIGHTS)
    rows = matrix(numbers, places, at + POLYNOMIALS)
    lanes, size = x.shape[1], inputs.shape[1]
    own = np.empty((size, lanes))
    for j in range(size):
        column = x[int(inputs[0, j])]
        for b in range(lanes):
            own[j, b] = column[b]
    smooth = _smooth(own, inputs[1], points)
    mean[:] = head[0, CENTRE]
    for j in range(size):
        for b in range(lanes):
            mean[b] += own[j, b] * (rows[OF_MEAN, j] + own[j, b] * rows[OF_MEAN + 1, j])
    for i in range(len(points)):
        for b in range(lanes):
            mean[b] += weights[0, i] * smooth[i, b]
    if wanted:
        k = _covariances(head, rows, own, smooth)
        _explain(matrix(numbers, places, at + FACTOR), k)
        _deviation(head, rows, own, k, deviation)
