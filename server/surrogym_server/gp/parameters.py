"""Free parameters of a process: logarithms of its hyperparameters, with bounds and normal priors.

theta = [log lengthscale (d), log sigma_f^2, log sigma_l^2 (if linear), log sigma_q^2 (if quadratic), log sigma_n^2].
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from surrogym_server.gp.kernel import Hyperparameters, Reflection

NOISE_FLOOR, MOST_NOISE = 1e-8, 2.0  # bounds of the noise variance, as shares of the output's variance

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FitOptions:
    """Options of a fit: which parts the kernel has, and normal priors (mean, standard deviation) on the logarithms of
    hyperparameters.

    Inputs and outputs are standardised. The prior median of a length scale grows with sqrt(d), as distances between
    points do (Hvarfner et al., ICML 2024).
    """

    linear: bool = True  # whether the kernel has a linear part
    quadratic: bool = False
    lengthscale_prior: tuple[float, float] = (math.log(2.0), 1.2)
    signal_prior: tuple[float, float] = (0.0, 2.0)
    linear_prior: tuple[float, float] = (0.0, 2.0)
    quadratic_prior: tuple[float, float] = (-2.0, 2.0)
    noise_prior: tuple[float, float] = (math.log(1e-7), 6.0)
    noise_floor: float = NOISE_FLOOR
    most_noise: float = MOST_NOISE
    max_iterations: int = 100


class Parameters:
    """Free parameters theta of a process over d inputs, which are the logarithms of its hyperparameters: their order,
    priors and bounds."""

    def __init__(self, d: int, options: FitOptions, reflection: Reflection | None) -> None:
        self.d, self.options, self.reflection = d, options, reflection
        lengthscale = (options.lengthscale_prior[0] + 0.5 * math.log(d), options.lengthscale_prior[1])
        priors = [lengthscale] * d + [options.signal_prior]
        priors += [options.linear_prior] * options.linear + [options.quadratic_prior] * options.quadratic
        self.prior = np.array([*priors, options.noise_prior])  # mean and standard deviation of each free parameter
        self.prior_constant = float(np.log(self.prior[:, 1]).sum())
        size = len(self.prior)
        self.lower, self.upper = np.full(size, math.log(1e-8)), np.full(size, math.log(1e4))
        self.lower[:d], self.upper[:d] = math.log(0.02), math.log(1e3)
        self.lower[-1], self.upper[-1] = math.log(options.noise_floor), math.log(options.most_noise)
        self.default_start = self.prior[:, 0].copy()
        self.default_start[-1] = math.log(1e-4)

    def theta(self, hyper: Hyperparameters) -> Array:
        """Return the free parameters theta of hyperparameters, clipped to the bounds. The method ``hyper`` converts
        theta back to hyperparameters."""
        variances = [hyper.signal_variance]
        variances += [hyper.linear_variance] * self.options.linear
        variances += [hyper.quadratic_variance] * self.options.quadratic
        values = np.array([*hyper.lengthscale.tolist(), *variances, hyper.noise_variance])
        clipped: Array = np.clip(np.log(values), self.lower, self.upper)
        return clipped

    def hyper(self, theta: Array) -> Hyperparameters:
        lengthscale, signal, linear, quadratic, noise = self.values(theta)
        return Hyperparameters(torch.from_numpy(lengthscale), signal, linear, quadratic, noise, self.reflection)

    def values(self, theta: Array) -> tuple[Array, float, float, float, float]:
        """Return the length scales (d,) and the variances of signal, linear part, quadratic part and noise at theta."""
        values = np.exp(theta)
        linear = float(values[self.d + 1]) if self.options.linear else 0.0
        quadratic = float(values[-2]) if self.options.quadratic else 0.0
        return values[: self.d], float(values[self.d]), linear, quadratic, float(values[-1])

    def standardised(self, theta: Array) -> Array:
        """Return for each free parameter in theta how far it is from its prior's mean, in the prior's standard
        deviations.

        The negative log density of the priors is half the sum of the squares of this result, plus the attribute
        ``prior_constant``, plus log(2 pi) / 2 for each free parameter.
        """
        distance: Array = (theta - self.prior[:, 0]) / self.prior[:, 1]
        return distance
