"""The search that all fits share: the evidence with its gradient, and its minimum by L-BFGS on one thread.

d log p(y) / d theta_j = 1/2 tr((beta beta^T - (K + sigma_n^2 I)^-1) dK/d theta_j); R&W (2006), eq. 5.9.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Protocol

import numpy as np
import scipy  # its parts are loaded on first use: a server that fits nothing starts without them
from threadpoolctl import ThreadpoolController
from torch import Tensor

from surrogym_server.gp.kernel import Polynomial, Reflection
from surrogym_server.gp.parameters import Array, FitOptions, Parameters


class Objective(Protocol):
    """A cost with its gradient, within bounds."""

    options: FitOptions
    lower: Array
    upper: Array

    def __call__(self, theta: Array) -> tuple[float, Array]: ...


def minimum(objective: Objective, start: Array) -> tuple[float, Array]:
    result = scipy.optimize.minimize(
        objective,
        np.clip(start, objective.lower, objective.upper),
        jac=True,
        method="L-BFGS-B",
        bounds=np.stack([objective.lower, objective.upper], 1),
        options={"maxiter": objective.options.max_iterations, "ftol": 1e-9, "gtol": 1e-5},
    )
    return float(result.fun), result.x


@cache
def blas() -> ThreadpoolController:
    """Limit BLAS to one thread. L-BFGS-B multiplies matrices of a dozen rows; with more threads it waits ten times as
    long as it computes if the machine has other work.

    SciPy has a BLAS library of its own, beside NumPy's. A controller only knows libraries that are loaded when it is
    made, so SciPy's parts are imported first.
    """
    for part in ("linalg", "optimize"):
        getattr(scipy, part)
    return ThreadpoolController().select(user_api="blas")


@dataclass(frozen=True)
class Evaluated:
    """An objective at one theta."""

    value: float
    slopes: Array  # over theta
    half: Array  # (P,) 1/2 (beta beta^T - K^-1), twice off the diagonal
    weighted: Array  # (1, P), or (2, P) with a reflection: half times the squared exponential
    weights: Array  # (n,) beta


class Evidence(Parameters):
    """Negative log evidence with priors, and its gradient.

    A fit makes thousands of evaluations on a few dozen points. So symmetric matrices are kept once, as pairs i >= j of
    points, (P,) with P = n (n + 1) / 2, and NumPy and LAPACK are called: calls of torch take longer than the
    computation.
    """

    def __init__(self, x: Tensor, y: Tensor, options: FitOptions, reflection: Reflection | None) -> None:
        super().__init__(x.shape[1], options, reflection)
        n = len(x)
        self.n, self.x, self.y = n, x.numpy(), y.numpy()
        self.rows, self.columns = np.tril_indices(n)
        self.places = self.rows * n + self.columns  # of the pairs in a matrix by rows
        self.twice = np.where(self.rows == self.columns, 1.0, 2.0)  # how often a pair occurs in a symmetric matrix
        mirrored = [] if reflection is None else [x * reflection.signs]
        differences = [other.numpy()[self.columns] - x.numpy()[self.rows] for other in (x, *mirrored)]
        self.squared = np.ascontiguousarray(np.concatenate(differences).T ** 2)  # (d, P) or (d, 2 P)
        self.parity = 0 if reflection is None else reflection.parity
        self.linear = self._pairs(Polynomial.of(1.0, 0.0, reflection, x)(x, x))
        self.quadratic = self._pairs(Polynomial.of(0.0, 1.0, reflection, x)(x, x))
        self.constant = 0.5 * n * math.log(2 * math.pi) + self.prior_constant

    @property
    def noisy_starts(self) -> list[Array]:
        """A start with the noise of equal points, if their results differ. A search that has explained such results by
        short length scales does not find the way to noise by itself."""
        equal = ~self.squared[:, : len(self.rows)].any(0) & (self.rows != self.columns)
        if not equal.any():
            return []
        noise = 0.5 * float(np.square(self.y[self.rows[equal]] - self.y[self.columns[equal]]).mean())
        if noise <= self.options.noise_floor:
            return []
        start = self.default_start.copy()
        start[-1] = math.log(noise)
        return [start]

    def __call__(self, theta: Array) -> tuple[float, Array]:
        terms = self.evaluated(theta)
        return (1e10, np.zeros_like(theta)) if terms is None else (terms.value, terms.slopes)

    def evaluated(self, theta: Array) -> Evaluated | None:
        """Value and gradient at theta. None if float64 can't factor K: a very large cost then stops the line search."""
        lengthscale, signal, linear, quadratic, noise = self.values(theta)
        precision = lengthscale**-2
        smooth = (-0.5 * precision) @ self.squared
        np.exp(smooth, out=smooth)
        smooth *= signal
        smooth = smooth.reshape(-1, len(self.rows))  # of the points, and of their mirror images
        k = smooth[0] + linear * self.linear + quadratic * self.quadratic
        if self.parity:
            smooth[1] *= self.parity
            k += smooth[1]
        matrix = np.zeros((self.n, self.n))
        matrix.ravel()[self.places] = k
        matrix.flat[:: self.n + 1] += noise
        if (solution := self._solve(matrix)) is None:
            return None
        inverse, weights, log_root = solution
        product = weights.take(self.rows) * weights.take(self.columns)
        half = 0.5 * self.twice * (product - inverse.ravel().take(self.places))
        weighted = half * smooth
        slopes = [precision * (self.squared @ weighted.ravel()), [weighted.sum()]]
        slopes += [[linear * (half @ self.linear)]] * self.options.linear
        slopes += [[quadratic * (half @ self.quadratic)]] * self.options.quadratic
        trace = 0.5 * (weights @ weights - inverse.trace())
        z = self.standardised(theta)
        value = 0.5 * (self.y @ weights + z @ z) + log_root + self.constant
        gradient = z / self.prior[:, 1] - np.concatenate([*slopes, [noise * trace]])
        return Evaluated(float(value), gradient, half, weighted, weights)

    def over_inputs(self, theta: Array, terms: Evaluated) -> Array:
        """Gradient of the value over the inputs x, (n, d). Only without a reflection and a quadratic part."""
        lengthscale, _, linear, _, _ = self.values(theta)
        smooth, line = np.zeros((self.n, self.n)), np.zeros((self.n, self.n))
        smooth.ravel()[self.places], line.ravel()[self.places] = terms.weighted[0], terms.half
        smooth, line = smooth + smooth.T, line + line.T  # each pair counts for both of its points
        pulled = (smooth.sum(1)[:, None] * self.x - smooth @ self.x) * lengthscale**-2
        slopes: Array = pulled - linear * (line @ self.x)
        return slopes

    def _solve(self, matrix: Array) -> tuple[Array, Array, float] | None:
        """From a matrix K, given by its lower half: the inverse (its lower half is valid), K^-1 y, and half of K's log
        determinant. None if K has no Cholesky factor."""
        lapack = scipy.linalg.lapack
        upper, info = lapack.dpotrf(matrix.T, lower=0, overwrite_a=1)  # transposed: the order that LAPACK wants
        if info:
            return None
        weights, _ = lapack.dpotrs(upper, self.y, lower=0)
        root = float(np.log(upper.diagonal()).sum())
        inverse, _ = lapack.dpotri(upper, lower=0, overwrite_c=1)
        return inverse.T, weights, root

    def _pairs(self, symmetric: Tensor) -> Array:
        """The pairs (P,) of a symmetric matrix (n, n)."""
        pairs: Array = symmetric.numpy()[self.rows, self.columns]
        return pairs
