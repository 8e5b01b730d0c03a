"""Hyperparameters by maximum marginal likelihood with priors (maximum a posteriori), L-BFGS with analytic gradients.

Free parameters are logarithms, theta = [log lengthscale (d), log sigma_f^2, log sigma_l^2 (if linear),
log sigma_q^2 (if quadratic), log sigma_n^2].
d log p(y) / d theta_j = 1/2 tr((beta beta^T - (K + sigma_n^2 I)^-1) dK/d theta_j); R&W (2006), eq. 5.9.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from threadpoolctl import ThreadpoolController
from torch import Tensor

from surrogym_server.gp.kernel import Hyperparameters, Polynomial, Reflection
from surrogym_server.gp.posterior import Posterior, condition

NOISE_FLOOR = 1e-8  # of the output's variance
MANY_POINTS = 24

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FitOptions:
    """What to fit, and the normal priors on logarithms: (mean, deviation). Inputs and outputs are standardised.

    The length scale's prior grows with sqrt(d), as distances do (Hvarfner et al., ICML 2024).
    """

    linear: bool = True  # parts beside the squared exponential
    quadratic: bool = False
    lengthscale_prior: tuple[float, float] = (math.log(2.0), 1.2)
    signal_prior: tuple[float, float] = (0.0, 2.0)
    linear_prior: tuple[float, float] = (0.0, 2.0)
    quadratic_prior: tuple[float, float] = (-2.0, 2.0)
    noise_prior: tuple[float, float] = (math.log(1e-7), 6.0)
    max_iterations: int = 100


@dataclass(frozen=True)
class Fitted:
    """A fit: the posterior, its score (log evidence at the optimum, priors included), and theta for a warm start."""

    posterior: Posterior
    score: float
    theta: Array


def fit(
    x: Tensor, y: Tensor, options: FitOptions, warm: Array | None = None, reflection: Reflection | None = None
) -> Fitted:
    """Fit a process to x (n, d) and y (n,), both standardised, of functions that have the ``reflection`` if given.

    ``warm`` is the theta of an earlier fit. Raises NumericalFailure.
    """
    objective = _Objective(x, y, options, reflection)
    with _blas().limit(limits=1):
        found = [_minimum(objective, start) for start in _starts(objective.default_start, warm, len(y))]
    value, theta = min(found, key=lambda pair: pair[0])
    return Fitted(condition(objective.hyper(theta), x, y), -value, theta)


def _minimum(objective: _Objective, start: Array) -> tuple[float, Array]:
    found = minimize(
        objective,
        np.clip(start, objective.lower, objective.upper),
        jac=True,
        method="L-BFGS-B",
        bounds=np.stack([objective.lower, objective.upper], 1),
        options={"maxiter": objective.options.max_iterations, "ftol": 1e-9, "gtol": 1e-5},
    )
    return float(found.fun), found.x


@cache
def _blas() -> ThreadpoolController:
    """L-BFGS-B multiplies matrices of a dozen rows: with more than one thread it waits ten times as long as it works,
    on a machine that does something else as well."""
    return ThreadpoolController().select(user_api="blas")


def _starts(default: Array, warm: Array | None, points: int) -> Sequence[Array]:
    """The default start, and a warm one. Few points have many optima, and a fit of them is cheap: both are tried; more
    than ``MANY_POINTS`` leave a warm start by itself but for one fit in four."""
    if warm is None:
        return (default,)
    return (warm,) if points > MANY_POINTS and points % 4 else (warm, default)


class _Objective:
    """Negative log evidence with priors, and its gradient. Squared differences are computed once."""

    def __init__(self, x: Tensor, y: Tensor, options: FitOptions, reflection: Reflection | None) -> None:
        self.y, self.options, self.reflection = y, options, reflection
        self.squared = [(1, _squared(x, x))]  # with the weight of their squared exponential
        if reflection is not None:
            self.squared.append((reflection.parity, _squared(x, x * reflection.signs)))
        self.linear = Polynomial.of(1.0, 0.0, reflection, x)(x, x)
        self.quadratic = Polynomial.of(0.0, 1.0, reflection, x)(x, x)
        n, d = x.shape
        lengthscale = (options.lengthscale_prior[0] + 0.5 * math.log(d), options.lengthscale_prior[1])
        priors = [lengthscale] * d + [options.signal_prior]
        priors += [options.linear_prior] * options.linear + [options.quadratic_prior] * options.quadratic
        self.prior = np.array([*priors, options.noise_prior])
        size = len(self.prior)
        self.lower, self.upper = np.full(size, math.log(1e-8)), np.full(size, math.log(1e4))
        self.lower[:d], self.upper[:d] = math.log(0.02), math.log(1e3)
        self.lower[-1], self.upper[-1] = math.log(NOISE_FLOOR), math.log(2.0)
        self.default_start = self.prior[:, 0].copy()
        self.default_start[-1] = math.log(1e-4)
        self.n, self.d = n, d

    def hyper(self, theta: Array) -> Hyperparameters:
        values = np.exp(theta)
        lengthscale = torch.as_tensor(values[: self.d], dtype=self.y.dtype, device=self.y.device)
        linear = float(values[self.d + 1]) if self.options.linear else 0.0
        quadratic = float(values[-2]) if self.options.quadratic else 0.0
        signal, noise = float(values[self.d]), float(values[-1])
        return Hyperparameters(lengthscale, signal, linear, quadratic, noise, self.reflection)

    def __call__(self, theta: Array) -> tuple[float, Array]:
        hyper = self.hyper(theta)
        precision = hyper.lengthscale.square().reciprocal()
        smooth = [
            weight * hyper.signal_variance * ((-0.5 * precision) @ squared).exp_().reshape(self.n, self.n)
            for weight, squared in self.squared
        ]
        k = sum(smooth) + hyper.linear_variance * self.linear + hyper.quadratic_variance * self.quadratic
        k.diagonal().add_(hyper.noise_variance)
        factor, info = torch.linalg.cholesky_ex(k)
        if bool(info):  # outside what float64 can factor: a wall for the line search
            return 1e10, np.zeros_like(theta)
        weights = torch.cholesky_solve(self.y[:, None], factor)[:, 0]
        log_evidence = -0.5 * (self.y @ weights) - factor.diagonal().log().sum() - 0.5 * self.n * math.log(2 * math.pi)
        half = 0.5 * (torch.outer(weights, weights) - torch.cholesky_inverse(factor))
        gradient = self._gradient(hyper, half, smooth, precision)
        z = (theta - self.prior[:, 0]) / self.prior[:, 1]
        value = -float(log_evidence) + 0.5 * float(z @ z) + float(np.log(self.prior[:, 1]).sum())
        return value, z / self.prior[:, 1] - gradient

    def _gradient(self, hyper: Hyperparameters, half: Tensor, smooth: list[Tensor], precision: Tensor) -> Array:
        weighted = [(half * part).flatten() for part in smooth]
        slopes = [squared @ part for (_, squared), part in zip(self.squared, weighted, strict=True)]
        parts = [precision * torch.stack(slopes).sum(0), torch.stack(weighted).sum()[None]]
        if self.options.linear:
            parts.append(hyper.linear_variance * torch.vdot(half.flatten(), self.linear.flatten())[None])
        if self.options.quadratic:
            parts.append(hyper.quadratic_variance * torch.vdot(half.flatten(), self.quadratic.flatten())[None])
        parts.append(hyper.noise_variance * half.trace()[None])
        gradient: Array = torch.cat(parts).cpu().numpy()
        return gradient


def _squared(a: Tensor, b: Tensor) -> Tensor:
    """Squared differences of inputs a and b (n, d) in each entry, (d, n n)."""
    return (b[None] - a[:, None]).square().permute(2, 0, 1).flatten(1)
