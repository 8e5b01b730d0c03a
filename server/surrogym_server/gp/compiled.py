"""Compiled code that predicts one Gaussian process: mean and standard deviation (without noise) at B inputs.

Exponents of the kernel are computed from differences of inputs. In ``gp.serving``, the reference implementation, they
come from matrix products, which would be no faster here.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from surrogym_server.compiled.elementary import dot, exponential, sine_and_cosine
from surrogym_server.compiled.tables import TablesBuilder, matrix
from surrogym_server.gp.kernel import to_mirror
from surrogym_server.gp.pathwise import frequencies
from surrogym_server.gp.posterior import Posterior
from surrogym_shared.compiled.jit import inlined

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# A process with d inputs and n training points is stored as eight matrices. Their indices, counted from its first one:
# HEAD (1, 11): scalars; SCALE to TURNS_ALL are their columns.
# INPUTS (2, d): which of the model's inputs the process reads, and inverse length scales.
# POINTS (S, d): training points divided by the length scales, then their mirror images if there is a reflection.
# WEIGHTS (1, S): weights of these S points in the mean.
# POLYNOMIALS (5 + 2 n, d): coefficients of x and x^2 in the mean, of x^2 and x^4 in the prior variance, of the mirror
#   image's exponent, and of the polynomial covariances with the n points (first linear, then quadratic).
# FACTOR (n, n): Cholesky factor L.
# KEPT, TURNED (d, 256): frequencies of posterior samples, divided by the length scales: KEPT for inputs whose sign a
#   reflection keeps, TURNED for inputs whose sign it changes.
HEAD, INPUTS, POINTS, WEIGHTS, POLYNOMIALS, FACTOR, KEPT, TURNED = range(8)
# Columns of HEAD: scale of the output, constant of the mean, constant of the prior variance, parity of the reflection
# (0 without one), signal variance, constant of the polynomial covariance, whether there is a polynomial part, number of
# points, whether there is a linear part, whether there is a quadratic part, whether a reflection turns every input.
SCALE, CENTRE, PRIOR, PARITY, SIGNAL, CONSTANT, POLYNOMIAL, COUNT, LINES, SQUARES, TURNS_ALL = range(11)
# The rows of the matrix POLYNOMIALS form four groups, of which these are the first rows: coefficients of the mean, of
# the prior variance, of the mirror image's exponent, and of the covariances with the training points.
OF_MEAN, OF_PRIOR, OF_MIRROR, OF_POINTS = 0, 2, 4, 5


def add_process(
    tables: TablesBuilder, posterior: Posterior, inputs: tuple[int, ...], centre: float, scale: float
) -> int:
    """Add the matrices of one output's process to the tables that compiled code reads. Return the index of the first
    of these matrices.

    Args:
        tables: tables under construction.
        posterior: the process.
        inputs: indices of the model's inputs that the process reads.
        centre, scale: the output is centre + scale * process.
    """
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
        hyper.linear_variance > 0,
        hyper.quadratic_variance > 0,
        reflection is not None and bool((reflection.signs < 0).all()),
    )
    rows = [
        scale * (posterior.weights @ linear),
        scale * (posterior.weights @ squares),
        polynomial.linear,
        polynomial.quadratic,
        mirror,
    ]
    turns = torch.zeros_like(hyper.lengthscale) if reflection is None else (1 - reflection.signs) / 2
    waves = frequencies(x.shape[1], x.device) / hyper.lengthscale[:, None]
    return tables.add(
        head,
        [inputs, (1 / hyper.lengthscale).tolist()],
        points / hyper.lengthscale,
        scale * hyper.signal_variance * weights,
        torch.cat([torch.stack(rows), linear, squares]),
        posterior.factor,
        waves * (1 - turns)[:, None],
        waves * turns[:, None],
    )


@inlined
def _smooth(own: Floats, inverse: Floats, points: Floats) -> Floats:
    """Return exp(-1/2 sum_j (x_j / l_j - X_ij)^2), (S, B), for B inputs x (d, B), length scales l and S points X (S,
    d), which are divided by the length scales.

    Args:
        own: inputs x of the process.
        inverse: inverse length scales 1 / l, (d,).
        points: the points X, already divided by the length scales.
    """
    size, lanes = own.shape
    scaled = np.empty_like(own)
    for j in range(size):
        for b in range(lanes):
            scaled[j, b] = own[j, b] * inverse[j]
    smooth = np.zeros((len(points), lanes))
    for i in range(len(points)):
        j = 0
        while j + 3 < size:
            for b in range(lanes):
                first, second = scaled[j, b] - points[i, j], scaled[j + 1, b] - points[i, j + 1]
                third, fourth = scaled[j + 2, b] - points[i, j + 2], scaled[j + 3, b] - points[i, j + 3]
                smooth[i, b] -= 0.5 * (first * first + second * second + third * third + fourth * fourth)
            j += 4
        while j < size:
            for b in range(lanes):
                difference = scaled[j, b] - points[i, j]
                smooth[i, b] -= 0.5 * difference * difference
            j += 1
    exponential(smooth.reshape(smooth.size))
    return smooth


@inlined
def _covariances(head: Floats, rows: Floats, own: Floats, smooth: Floats) -> Floats:
    """Return the prior covariances (n, B) of the n training points with the inputs ``own`` (d, B).

    Args:
        head: scalars of the process, such as its scale: its matrix HEAD (1, 11).
        rows: coefficients of the polynomial parts of the process: its matrix POLYNOMIALS (5 + 2 n, d).
        own: inputs of the process.
        smooth: squared exponentials of the inputs with the n points and then with their mirror images, if there is a
            reflection, (S, B).
    """
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
    """Replace k (n, B) by L^-1 k in place, with the lower triangular matrix L = ``factor`` (n, n)."""
    lanes = k.shape[1]
    for i in range(len(factor)):
        j = 0
        while j + 3 < i:
            first, second, third, fourth = factor[i, j], factor[i, j + 1], factor[i, j + 2], factor[i, j + 3]
            for b in range(lanes):
                k[i, b] -= first * k[j, b] + second * k[j + 1, b] + third * k[j + 2, b] + fourth * k[j + 3, b]
            j += 4
        while j < i:
            for b in range(lanes):
                k[i, b] -= factor[i, j] * k[j, b]
            j += 1
        pivot = 1 / factor[i, i]
        for b in range(lanes):
            k[i, b] *= pivot


@inlined
def _std(head: Floats, rows: Floats, own: Floats, explained: Floats, std: Floats) -> None:
    """Write the standard deviation without noise, sqrt(k(x, x) - |L^-1 k|^2), in the output's unit, to ``std`` (B,).

    Args:
        head: scalars of the process, such as its scale: its matrix HEAD (1, 11).
        rows: coefficients of the polynomial parts of the process: its matrix POLYNOMIALS (5 + 2 n, d).
        own: inputs x of the process, (d, B).
        explained: L^-1 k, (n, B), with the covariances k of the inputs with the n points. Its squares are the variance
            that the points explain.
        std: array for the result.
    """
    size, lanes = own.shape
    std[:] = 0.0
    if head[0, PARITY] != 0:
        for j in range(size):
            for b in range(lanes):
                std[b] += rows[OF_MIRROR, j] * own[j, b] * own[j, b]
        exponential(std)
        for b in range(lanes):
            std[b] *= head[0, PARITY] * head[0, SIGNAL]
    for b in range(lanes):
        std[b] += head[0, PRIOR]
    for j in range(size):
        for b in range(lanes):
            square = own[j, b] * own[j, b]
            std[b] += square * (rows[OF_PRIOR, j] + square * rows[OF_PRIOR + 1, j])
    for i in range(len(explained)):
        for b in range(lanes):
            std[b] -= explained[i, b] * explained[i, b]
    for b in range(lanes):
        std[b] = head[0, SCALE] * np.sqrt(max(std[b], 0.0))


@inlined
def _add_residuals(
    head: Floats, rows: Floats, kept: Floats, turned: Floats, own: Floats, k: Floats, paths: Floats, mean: Floats
) -> None:
    """Add to ``mean`` (B,) the difference between a posterior sample and the posterior mean, at B inputs with one
    sample each.

    Args:
        head: scalars of the process, such as its scale: its matrix HEAD (1, 11).
        rows: coefficients of the polynomial parts of the process: its matrix POLYNOMIALS (5 + 2 n, d).
        kept, turned: random Fourier frequencies of the process: its matrices KEPT and TURNED (d, S), with S
            frequencies. KEPT is 0 for inputs whose sign the mirror symmetry changes, TURNED for all others.
        own: inputs of the process, (d, B).
        k: covariances of the inputs with the n points, (n, B).
        paths: weights of the posterior samples, one row for each input, (B, W); the first columns belong to this
            process.
        mean: means in the output's unit, changed in place.
    """
    (size, count), parity, scale = kept.shape, head[0, PARITY], head[0, SCALE]
    straight, mirrored = np.empty(count), np.empty(count)
    sine, cosine = np.empty(count), np.empty(count)
    for b in range(len(mean)):
        for s in range(count):
            straight[s] = mirrored[s] = 0.0
        for j in range(size):
            for s in range(count):
                straight[s] += own[j, b] * kept[j, s]
                mirrored[s] += own[j, b] * turned[j, s]
        for s in range(count):
            stays, changes = straight[s], mirrored[s]
            straight[s], mirrored[s] = stays + changes, stays - changes
        sine_and_cosine(straight, sine, cosine)
        amplitude = np.sqrt(head[0, SIGNAL] / count)
        total = dot(cosine, paths[b, :count]) + dot(sine, paths[b, count : 2 * count])
        if parity != 0:
            # A mirror image that changes the sign of every input has the opposite phase: cos(-a) = cos(a), sin(-a) =
            # -sin(a).
            if head[0, TURNS_ALL]:
                total += parity * (dot(cosine, paths[b, :count]) - dot(sine, paths[b, count : 2 * count]))
            else:
                sine_and_cosine(mirrored, sine, cosine)
                total += parity * (dot(cosine, paths[b, :count]) + dot(sine, paths[b, count : 2 * count]))
            amplitude /= np.sqrt(2.0)
        total *= amplitude
        at = 2 * count
        if head[0, LINES]:
            total += np.sqrt(head[0, CONSTANT]) * paths[b, at]
            for j in range(size):
                total += np.sqrt(rows[OF_PRIOR, j]) * own[j, b] * paths[b, at + 1 + j]
            at += 1 + size
        if head[0, SQUARES]:
            for j in range(size):
                total += np.sqrt(rows[OF_PRIOR + 1, j]) * own[j, b] * own[j, b] * paths[b, at + j]
            at += size
        for i in range(len(k)):
            total += k[i, b] * paths[b, at + i]
        mean[b] += scale * total


@inlined
def predict(
    numbers: Floats, places: Ints, at: int, x: Floats, wanted: bool, paths: Floats, mean: Floats, std: Floats
) -> None:
    """Predict one output at inputs x (d, B), each a column, and write the results to ``mean`` (B,) and ``std`` (B,).

    Args:
        numbers, places: tables of matrices, see ``compiled.tables``.
        at: index of the process's first matrix in the tables.
        x: all d inputs of the model, of which the process reads some.
        wanted: whether to write standard deviations (without noise) to ``std``.
        paths: if it has no rows, ``mean`` gets the posterior means. If it is (B, W), row b has the weights of a
            posterior sample, and ``mean[b]`` gets the value of this sample at input b.
        mean, std: arrays for the results, in the output's unit.
    """
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
    if not wanted and not len(paths):
        return
    k = _covariances(head, rows, own, smooth)
    if len(paths):
        kept, turned = matrix(numbers, places, at + KEPT), matrix(numbers, places, at + TURNED)
        _add_residuals(head, rows, kept, turned, own, k, paths, mean)
    if wanted:
        _explain(matrix(numbers, places, at + FACTOR), k)
        _std(head, rows, own, k, std)
