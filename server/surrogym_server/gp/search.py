"""The search that all fits share: the evidence with its gradient, and its minimum by L-BFGS on one thread.

d log p(y) / d theta_j = 1/2 tr((beta beta^T - (K + sigma_n^2 I)^-1) dK/d theta_j); R&W (2006), eq. 5.9.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Protocol

import numpy as np
import scipy  # SciPy imports its submodules on first use, so a server that fits no model starts sooner
from threadpoolctl import ThreadpoolController
from torch import Tensor

from surrogym_server.gp.kernel import Polynomial, Reflection
from surrogym_server.gp.parameters import Array, FitOptions, Parameters


class Objective(Protocol):
    """Cost as a function of free parameters theta, with its gradient and the bounds of theta."""

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
    """Return a handle that limits the threads of all BLAS libraries in the process.

    L-BFGS-B multiplies matrices of a dozen rows. With more than one thread, on a machine that has other work, it would
    wait ten times as long as it computes. SciPy has a BLAS library beside NumPy's, and a controller only knows
    libraries that were loaded before it, so SciPy's parts are imported first.
    """
    for part in ("linalg", "optimize"):
        getattr(scipy, part)
    return ThreadpoolController().select(user_api="blas")


@dataclass(frozen=True)
class Evaluated:
    """Negative log evidence and its gradient at one theta, with intermediate results."""

    value: float
    slopes: Array  # gradient of ``value`` with respect to theta
    half: Array  # (P,) entries (i, j), i >= j, of 1/2 (beta beta^T - K^-1) for P pairs of points; doubled if i > j
    # (1, P) product of ``half`` and the squared exponential for P pairs of points; (2, P) with a reflection.
    weighted: Array
    weights: Array  # (n,) beta = K^-1 y


class Evidence(Parameters):
    """Negative log evidence of n points, priors of hyperparameters included, as a function of theta, with its gradient.

    A fit makes thousands of evaluations on a few dozen points. So of each symmetric matrix only the entries with i >= j
    are stored, (P,) with P = n (n + 1) / 2. The computation uses NumPy and LAPACK, because calls of torch would take
    longer than the computation itself.
    """

    def __init__(self, x: Tensor, y: Tensor, options: FitOptions, reflection: Reflection | None) -> None:
        super().__init__(x.shape[1], options, reflection)
        n = len(x)
        self.n, self.x, self.y = n, x.numpy(), y.numpy()
        self.rows, self.columns = np.tril_indices(n)
        self.places = self.rows * n + self.columns  # index of each entry (i, j), i >= j, in the flattened (n, n) matrix
        # How often the value of each entry (i, j) with i >= j occurs in a symmetric matrix.
        self.twice = np.where(self.rows == self.columns, 1.0, 2.0)
        mirrored = [] if reflection is None else [x * reflection.signs]
        differences = [other.numpy()[self.columns] - x.numpy()[self.rows] for other in (x, *mirrored)]
        # (d, P) squared differences of the d inputs between the points of each of P pairs. With a reflection, the
        # squared differences between a point and the mirror image of another follow, (d, 2 P).
        self.squared = np.ascontiguousarray(np.concatenate(differences).T ** 2)
        self.parity = 0 if reflection is None else reflection.parity
        self.linear = self._pairs(Polynomial.of(1.0, 0.0, reflection, x)(x, x))
        self.quadratic = self._pairs(Polynomial.of(0.0, 1.0, reflection, x)(x, x))
        self.constant = 0.5 * n * math.log(2 * math.pi) + self.prior_constant

    @property
    def noisy_starts(self) -> list[Array]:
        """Further thetas at which to start a search: one if points with equal inputs have different targets, otherwise
        none. Its noise variance is estimated from these points.

        A search that has explained such targets by short length scales does not find the noisy optimum by itself.
        """
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
        """Return the negative log evidence and its gradient at theta; None if the covariance matrix has no Cholesky
        factor in float64."""
        lengthscale, signal, linear, quadratic, noise = self.values(theta)
        precision = lengthscale**-2
        smooth = (-0.5 * precision) @ self.squared
        np.exp(smooth, out=smooth)
        smooth *= signal
        # The first row is for pairs of points; with a reflection, a second is for pairs of a point and a mirror image.
        smooth = smooth.reshape(-1, len(self.rows))
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
        """Return the gradient of the negative log evidence at theta with respect to the inputs x, (n, d). ``terms`` is
        the result of ``evaluated`` at theta.

        Valid only without a reflection and without a quadratic part.
        """
        lengthscale, _, linear, _, _ = self.values(theta)
        smooth, line = np.zeros((self.n, self.n)), np.zeros((self.n, self.n))
        smooth.ravel()[self.places], line.ravel()[self.places] = terms.weighted[0], terms.half
        smooth, line = smooth + smooth.T, line + line.T  # each pair contributes to the gradients of both of its points
        pulled = (smooth.sum(1)[:, None] * self.x - smooth @ self.x) * lengthscale**-2
        slopes: Array = pulled - linear * (line @ self.x)
        return slopes

    def _solve(self, matrix: Array) -> tuple[Array, Array, float] | None:
        """Return K^-1 (only its lower half is valid), K^-1 y, and 1/2 log det K; None if K has no Cholesky factor.

        Args:
            matrix: the covariance matrix K (n, n), noise included. Only its lower half is read, and it is overwritten.
        """
        lapack = scipy.linalg.lapack
        upper, info = lapack.dpotrf(matrix.T, lower=0, overwrite_a=1)  # the transpose has LAPACK's column order
        if info:
            return None
        weights, _ = lapack.dpotrs(upper, self.y, lower=0)
        root = float(np.log(upper.diagonal()).sum())
        inverse, _ = lapack.dpotri(upper, lower=0, overwrite_c=1)
        return inverse.T, weights, root

    def _pairs(self, symmetric: Tensor) -> Array:
        """Return the P entries (P,) with i >= j of a symmetric matrix (n, n)."""
        pairs: Array = symmetric.numpy()[self.rows, self.columns]
        return pairs
