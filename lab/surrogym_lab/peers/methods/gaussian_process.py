"""Independent exact Gaussian processes, one for each output, with squared exponential kernels (torch, double).

Shapes: n samples, m points, I inputs, E outputs. M. P. Deisenroth, C. E. Rasmussen, "PILCO", ICML 2011, section 2.1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.linalg import LinAlgError
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import minimize
from torch import Tensor

from surrogym_sampler.original.protocol import Array

MOST = 300  # samples; PILCO's authors take 300 inducing points beyond, we take a random subset
SPREAD, POWER = 100.0, 30  # of PILCO's penalty: limit of a length scale, and steepness
ITERATIONS = 200
JITTER = 1e-9  # relative to the signal's variance
BLOCK = 64  # rows of a factor's inverse that are multiplied at once


@dataclass(frozen=True)
class Processes:
    """Fitted processes.

    Attributes:
        x: inputs (n, I).
        lengthscale: (E, I); ``signal``, ``noise``: standard deviations (E,).
        factor: Cholesky factor (E, n, n) of K + noise^2 I.
        weights: beta = (K + noise^2 I)^-1 y, (E, n).
    """

    x: Tensor
    lengthscale: Tensor
    signal: Tensor
    noise: Tensor
    factor: Tensor
    weights: Tensor

    @property
    def inverse(self) -> Tensor:
        """(K + noise^2 I)^-1, (E, n, n)."""
        return torch.cholesky_inverse(self.factor)

    def predict(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation (m, E) of the functions at points (m, I), without noise (equations 6 and 7).
        Not for gradients."""
        mean, deviation = self._predictor(x.numpy())
        return torch.from_numpy(mean), torch.from_numpy(deviation)

    @cached_property
    def _predictor(self) -> _Predictor:
        return _Predictor(self)


class _Predictor:
    """What predictions need of processes, in NumPy: the Cholesky factors' inverses, whose products with many points
    are faster than solving, in blocks of rows, which skip most of the zeros."""

    def __init__(self, model: Processes) -> None:
        eye = torch.eye(len(model.x), dtype=model.x.dtype).expand_as(model.factor)
        roots = torch.linalg.solve_triangular(model.factor, eye, upper=False).numpy()
        ends = [(begin, min(begin + BLOCK, len(model.x))) for begin in range(0, len(model.x), BLOCK)]
        self._parts = [[np.ascontiguousarray(root[begin:end, :end]) for begin, end in ends] for root in roots]
        self._weights = model.weights.numpy()
        self._scale, self._variance = 1 / model.lengthscale.numpy(), model.signal.numpy() ** 2
        scaled = model.x.numpy() * self._scale[:, None]
        squared = np.log(self._variance)[:, None] - (scaled**2).sum(-1) / 2
        self._points = np.concatenate([scaled, squared[..., None], np.ones((*scaled.shape[:2], 1))], -1)  # (E, n, I+2)

    def __call__(self, x: Array) -> tuple[Array, Array]:
        """Means and standard deviations (m, E) at points (m, I)."""
        shape = len(x), len(self._scale)
        mean, deviation, one = np.empty(shape), np.empty(shape), np.ones((len(x), 1))
        for output, points in enumerate(self._points):
            scaled = x * self._scale[output]
            k = points @ np.concatenate([scaled, one, -(scaled**2).sum(1, keepdims=True) / 2], 1).T  # (n, m)
            np.exp(np.minimum(k, np.log(self._variance[output]), out=k), out=k)
            mean[:, output] = self._weights[output] @ k
            explained = np.zeros(len(x))
            for part in self._parts[output]:
                half = part @ k[: part.shape[1]]
                explained += np.einsum("nm,nm->m", half, half)
            deviation[:, output] = np.sqrt(np.maximum(self._variance[output] - explained, 1e-12))
        return mean, deviation


def kernel(a: Tensor, b: Tensor, lengthscale: Tensor, signal: Tensor) -> Tensor:
    """Covariances (E, m, n) of points (m, I) and (n, I)."""
    a, b = a / lengthscale[:, None], b / lengthscale[:, None]
    squared = (a**2).sum(-1)[:, :, None] + (b**2).sum(-1)[:, None] - 2 * a @ b.mT
    return signal[:, None, None] ** 2 * torch.exp(-squared.clamp_min(0) / 2)


def conditioned(x: Tensor, y: Tensor, lengthscale: Tensor, signal: Tensor, noise: Tensor) -> Processes:
    """Processes with given hyperparameters, conditioned on inputs (n, I) and outputs (n, E)."""
    variance = noise**2 + JITTER * signal**2
    k = kernel(x, x, lengthscale, signal) + variance[:, None, None] * torch.eye(len(x), dtype=x.dtype)
    factor = torch.linalg.cholesky(k)
    weights = torch.cholesky_solve(y.T[..., None], factor)[..., 0]
    return Processes(x, lengthscale, signal, noise, factor, weights)


def fit(
    x: Array, y: Array, signal_to_noise: float, rng: np.random.Generator, check: Callable[[], None] = lambda: None
) -> Processes:
    """Fit hyperparameters by evidence with the penalty of PILCO's authors, from their starting point.

    Args:
        x: inputs (n, I).
        y: outputs (n, E).
        signal_to_noise: limit of the ratio of the deviations of signal and noise.
        rng: draws a subset of many samples.
        check: called at each evaluation.
    """
    if len(x) > MOST:
        kept = rng.choice(len(x), MOST, replace=False)
        x, y = x[kept], y[kept]
    found = [_fit_one(x, column, signal_to_noise, check) for column in y.T]
    lengthscale, signal, noise = (torch.from_numpy(np.stack(part)) for part in zip(*found, strict=True))
    return conditioned(torch.from_numpy(x), torch.from_numpy(y), lengthscale, signal, noise)


def _fit_one(x: Array, y: Array, signal_to_noise: float, check: Callable[[], None]) -> tuple[Array, float, float]:
    """Length scales (I,), signal and noise of one output (n,)."""
    spread = np.maximum(x.std(0, ddof=1), 1e-3)
    level = max(y.std(ddof=1), 1e-6)
    start = np.log([*spread, level, level / 10])

    def objective(theta: Array) -> tuple[float, Array]:
        check()
        try:
            loss, slope = negative_log_evidence(x, y, theta)
        except LinAlgError:  # no Cholesky factor
            return np.nan, np.zeros_like(theta)
        penalty, further = _penalty(theta, spread, signal_to_noise)
        return loss + penalty, slope + further

    found = lowest(objective, start, [(v - 7, v + 7) for v in start], maxiter=ITERATIONS)
    return np.exp(found[:-2]), *np.exp(found[-2:])


def lowest(
    objective: Callable[[Array], tuple[float, Array]],
    start: Array,
    bounds: Sequence[tuple[float, float]] | None = None,
    **options: float,
) -> Array:
    """Argument with the lowest value that L-BFGS finds.

    A trial step of a line search may go so far that the objective has no finite value or slope. There it counts as
    flat and worse than at the start, so that the line search takes a smaller step. An infinite value would end it.

    Args:
        objective: value and slope.
        start: where the objective has a value.
        bounds: of each entry.
        options: of SciPy's L-BFGS-B.
    """
    worst = objective(start)[0] + 1

    def finite(at: Array) -> tuple[float, Array]:
        value, slope = objective(at)
        if np.isfinite(value) and np.isfinite(slope).all():
            return value, slope
        return worst, np.zeros_like(at)

    found: Array = minimize(finite, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options).x
    return found


def negative_log_evidence(x: Array, y: Array, theta: Array) -> tuple[float, Array]:
    """Negative log evidence of an output (n,), without its constant, and its gradient.

    Args:
        x: inputs (n, I).
        y: the output.
        theta: logarithms of the length scales, signal and noise (I + 2,).

    Raises:
        LinAlgError: the covariances have no Cholesky factor.
    """
    signal, noise = np.exp(2 * theta[-2:])  # variances
    z = x * np.exp(-theta[:-2])
    squared = (z**2).sum(1)
    k = signal * np.exp(np.minimum(z @ z.T - squared[:, None] / 2 - squared / 2, 0))
    factor = cholesky(k + (noise + JITTER * signal) * np.eye(len(x)), lower=True, check_finite=False)
    root = solve_triangular(factor, np.eye(len(x)), lower=True, check_finite=False)
    weights = root.T @ (root @ y)
    by_k = root.T @ root - np.outer(weights, weights)  # twice the derivative by the covariances
    trace, by_log_k = np.trace(by_k), by_k * k
    by_scales = by_log_k.sum(1) @ z**2 - (z * (by_log_k @ z)).sum(0)
    slope = [*by_scales, by_log_k.sum() + JITTER * signal * trace, noise * trace]
    return float(y @ weights / 2 + np.log(np.diag(factor)).sum()), np.array(slope)


def _penalty(theta: Array, spread: Array, signal_to_noise: float) -> tuple[float, Array]:
    """A penalty and its gradient. It grows steeply where the ratio of signal and noise is at its limit, or a length
    scale is 100 times the inputs' deviation or a hundredth of it (PILCO's ``hypCurb``)."""
    limits = np.log([*np.full(len(spread), SPREAD), signal_to_noise])
    over = np.append(theta[:-2] - np.log(spread), theta[-2] - theta[-1]) / limits
    slope = POWER * over ** (POWER - 1) / limits
    return float((over**POWER).sum()), np.append(slope, -slope[-1])
