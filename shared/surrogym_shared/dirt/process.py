"""A small Gaussian process for some 60 points, with NumPy alone: hyperparameters by maximum a posteriori.

Kernel: sigma_f^2 exp(-1/2 sum_i ((x_i - x'_i) / l_i)^2) + lambda^2 (1 + x^T x'), and noise of the covariance
sigma_n^2 S + ``FLOOR``^2 I, where S is the identity or given (C. E. Rasmussen, C. K. I. Williams, "Gaussian Processes
for Machine Learning", 2006, chapters 4 and 5).

Shapes: n points, d inputs, p = d + 3 hyperparameters.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from surrogym_shared.dirt.rollouts import Array

# Logarithms of length scales, sigma_f, lambda and sigma_n: mean and standard deviation of their normal priors.
LENGTH, SIGNAL, LINEAR, NOISE = (2.0, 0.6), (-1.0, 1.5), (-0.5, 1.5), (-4.0, 3.0)
# Standard deviation of noise that every process has, as a share of the output's standard deviation. Effects that are
# smaller than this noise then do not decide between two explanations.
FLOOR = 0.02
QUIET = -9.0  # logarithm of a sigma_n that counts as none
JITTER = 1e-10  # added to the diagonal of a covariance, as a share of its mean
ITERATIONS = 60
ENOUGH = 1e-3  # a search ends if a step lowers the objective by less


@dataclass(frozen=True)
class Process:
    """A fitted process.

    Attributes:
        theta: logarithms of the hyperparameters (p,): length scales, sigma_f, lambda, sigma_n.
        evidence: logarithm of the marginal likelihood of the outputs.
        off: errors of the points (n,), each predicted from the others.
        noise: sigma_n.
    """

    theta: Array
    evidence: float
    off: Array

    @property
    def noise(self) -> float:
        return math.exp(self.theta[-1])


def fitted(
    x: Array,
    y: Array,
    start: Array | None = None,
    iterations: int = ITERATIONS,
    *,
    noise: Array | None = None,
    noiseless: bool = False,
) -> Process:
    """Fit a process to inputs x (n, d) and outputs y (n,), both standardised.

    Args:
        x: inputs.
        y: outputs.
        start: logarithms of the hyperparameters (p,) at which the search starts; None for the means of their priors.
        iterations: largest number of iterations.
        noise: S (n, n), the covariance of the noise without its factor; None for the identity.
        noiseless: whether sigma_n stays as small as possible.
    """
    mean, std = _prior(x.shape[1])
    theta = mean if start is None else start.copy()
    if noiseless:
        mean[-1], std[-1], theta[-1] = QUIET, 1e-3, QUIET
    square = (x.T[:, :, None] - x.T[:, None, :]) ** 2  # (d, n, n)
    parts = _Parts(square, 1 + x @ x.T, np.eye(len(x)) if noise is None else noise)
    value, slope = _objective(theta, parts, y, mean, std)
    inverse = np.diag(1 / (1 / std**2 + 1.0))  # approximate inverse Hessian (p, p), by BFGS
    for _ in range(iterations):
        step = -inverse @ slope
        step *= min(1.0, 2.0 / max(float(np.abs(step).max()), 1e-12))
        length, moved = 1.0, None
        while length > 1e-3:
            moved = _objective(theta + length * step, parts, y, mean, std)
            if moved[0] <= value + 1e-4 * length * float(slope @ step):
                break
            length /= 3
        else:
            break
        s, g = length * step, moved[1] - slope
        if (curved := float(s @ g)) > 1e-10:
            left = np.eye(len(s)) - np.outer(s, g) / curved
            inverse = left @ inverse @ left.T + np.outer(s, s) / curved
        gained, theta, value, slope = value - moved[0], theta + s, moved[0], moved[1]
        if gained < ENOUGH:
            break
    return at(x, y, theta, noise)


def at(x: Array, y: Array, theta: Array, noise: Array | None = None) -> Process:
    """Return the process with given logarithms of hyperparameters, theta (p,)."""
    square = (x.T[:, :, None] - x.T[:, None, :]) ** 2
    k = _covariance(theta, _Parts(square, 1 + x @ x.T, np.eye(len(x)) if noise is None else noise))[0]
    inverse, half_log = _inverse(k)
    beta = inverse @ y
    evidence = -0.5 * float(y @ beta) - half_log - 0.5 * len(y) * math.log(2 * math.pi)
    return Process(theta, evidence, beta / inverse.diagonal())  # R&W, eq. 5.12


@dataclass(frozen=True)
class _Parts:
    """What a covariance is made of: squared differences (d, n, n), 1 + x^T x' (n, n), and S (n, n)."""

    square: Array
    linear: Array
    noise: Array


def _prior(d: int) -> tuple[Array, Array]:
    rows = [LENGTH] * d + [SIGNAL, LINEAR, NOISE]
    return np.array([m for m, _ in rows]), np.array([s for _, s in rows])


def _covariance(theta: Array, parts: _Parts) -> tuple[Array, Array]:
    """Return the covariance with noise (n, n), and its squared exponential part."""
    d = len(parts.square)
    smooth = np.exp(2 * theta[d] - 0.5 * np.tensordot(np.exp(-2 * theta[:d]), parts.square, 1))
    linear, noise = math.exp(2 * theta[d + 1]) * parts.linear, math.exp(2 * theta[-1]) * parts.noise
    return smooth + linear + noise + FLOOR**2 * np.eye(len(linear)), smooth


def _inverse(k: Array) -> tuple[Array, float]:
    """Return the inverse of a covariance (n, n), and half the logarithm of its determinant."""
    factor = np.linalg.cholesky(k + JITTER * float(k.diagonal().mean()) * np.eye(len(k)))
    low = np.linalg.inv(factor)
    return low.T @ low, float(np.log(factor.diagonal()).sum())


def _objective(theta: Array, parts: _Parts, y: Array, mean: Array, std: Array) -> tuple[float, Array]:
    """Return the negative logarithm of the posterior, and its gradient (p,) (R&W, eq. 5.9)."""
    d = len(parts.square)
    k, smooth = _covariance(theta, parts)
    try:
        inverse, half_log = _inverse(k)
    except np.linalg.LinAlgError:  # a step of the search that went too far
        return math.inf, np.zeros(len(theta))
    beta = inverse @ y
    off = (theta - mean) / std
    value = 0.5 * float(y @ beta) + half_log + 0.5 * float(off @ off)
    w = 0.5 * (inverse - np.outer(beta, beta))  # d value / d K
    slope = off / std
    slope[:d] += np.exp(-2 * theta[:d]) * np.tensordot(parts.square, w * smooth, 2)
    slope[d] += 2 * float((w * smooth).sum())
    slope[d + 1] += 2 * math.exp(2 * theta[d + 1]) * float((w * parts.linear).sum())
    slope[d + 2] += 2 * math.exp(2 * theta[-1]) * float((w * parts.noise).sum())
    return value, slope
