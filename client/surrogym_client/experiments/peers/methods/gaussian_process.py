"""Independent exact Gaussian processes, one for each output, with squared exponential kernels (torch, double).

Shapes: n samples, m points, I inputs, E outputs. M. P. Deisenroth, C. E. Rasmussen, "PILCO", ICML 2011, section 2.1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from surrogym_client.original.protocol import Array

MOST = 300  # samples; PILCO's authors take 300 inducing points beyond, we take a random subset
SIGNAL_TO_NOISE, SPREAD, POWER = 500.0, 100.0, 30  # limits of hyperparameters as in the authors' penalty
ITERATIONS = 200
JITTER = 1e-9  # relative to the signal's variance


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
        """Mean and standard deviation (m, E) of the functions at points (m, I), without noise (equations 6 and 7)."""
        k = kernel(x, self.x, self.lengthscale, self.signal)  # (E, m, n)
        mean = (k @ self.weights[..., None])[..., 0]
        half = torch.linalg.solve_triangular(self.factor, k.mT, upper=False)  # (E, n, m)
        variance = self.signal[:, None] ** 2 - (half**2).sum(1)
        return mean.T, variance.clamp_min(1e-12).sqrt().T


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


def fit(x: Array, y: Array, rng: np.random.Generator, check: Callable[[], None] = lambda: None) -> Processes:
    """Fit hyperparameters by evidence with the authors' penalty, from their starting point.

    Args:
        x: inputs (n, I).
        y: outputs (n, E).
        rng: draws a subset of many samples.
        check: called at each evaluation.
    """
    if len(x) > MOST:
        kept = rng.choice(len(x), MOST, replace=False)
        x, y = x[kept], y[kept]
    inputs, outputs = torch.from_numpy(x), torch.from_numpy(y)
    found = [_fit_one(inputs, column, check) for column in outputs.T]
    lengthscale, signal, noise = (torch.stack(part) for part in zip(*found, strict=True))
    return conditioned(inputs, outputs, lengthscale, signal, noise)


def _fit_one(x: Tensor, y: Tensor, check: Callable[[], None]) -> tuple[Tensor, Tensor, Tensor]:
    """Length scales (I,), signal and noise of one output (n,)."""
    spread = x.std(0).clamp_min(1e-3)
    level = y.std().clamp_min(1e-6)
    start = torch.cat([spread.log(), level.log()[None], (level / 10).log()[None]])

    def objective(values: Array) -> tuple[float, Array]:
        check()
        theta = torch.from_numpy(values).requires_grad_()
        loss = _negative_log_evidence(x, y, theta) + _penalty(theta, spread)
        loss.backward()  # type: ignore[no-untyped-call]
        assert theta.grad is not None
        return loss.item(), theta.grad.numpy()

    bounds = [(float(v) - 7, float(v) + 7) for v in start]
    found = minimize(
        objective, start.numpy(), jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": ITERATIONS}
    )
    theta = torch.from_numpy(found.x)
    return theta[:-2].exp(), theta[-2].exp(), theta[-1].exp()


def _negative_log_evidence(x: Tensor, y: Tensor, theta: Tensor) -> Tensor:
    lengthscale, signal, noise = theta[None, :-2].exp(), theta[-2:-1].exp(), theta[-1:].exp()
    model = conditioned(x, y[:, None], lengthscale, signal, noise)
    return y @ model.weights[0] / 2 + model.factor[0].diagonal().log().sum()


def _penalty(theta: Tensor, spread: Tensor) -> Tensor:
    """Grows steeply where the signal is 500 times the noise, or a length scale 100 times the inputs' deviation or a
    hundredth of it (the authors' ``hypCurb``)."""
    ratio = (theta[-2] - theta[-1]) / np.log(SIGNAL_TO_NOISE)
    scales = (theta[:-2] - spread.log()) / np.log(SPREAD)
    penalty: Tensor = ratio**POWER + (scales**POWER).sum()
    return penalty
