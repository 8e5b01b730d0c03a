"""Samples from the posterior of hyperparameters, for processes with few points, which leave hyperparameters uncertain.

The prior of theta, the logarithms, is normal, so elliptical slice sampling needs no step size. It rotates theta around
the prior's mean, in the plane through theta and a new sample of the prior, until the evidence exceeds a random level.

Reference: Murray, Adams, MacKay, "Elliptical slice sampling", AISTATS 2010, figure 2.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from surrogym_server.gp.kernel import Hyperparameters
from surrogym_server.gp.parameters import MOST_NOISE, NOISE_FLOOR, FitOptions
from surrogym_server.gp.posterior import Posterior
from surrogym_server.gp.search import Evidence, blas, minimum

BURN_IN, THINNING = 30, 10  # the first 30 updates of the chain are discarded, then every tenth is a sample
# If samples may have less noise than the fit, the likeliest hyperparameters with less noise are searched for. One
# search starts at the logarithms of the fitted length scales less each of these numbers.
SHORTER = (0.0, 1.0, 2.0)
# Elliptical slice sampling leaves theta unchanged if its interval of angles becomes narrower than this, in radians.
NARROWEST = 1e-6

Array = NDArray[np.float64]


def hyperparameter_samples(
    posterior: Posterior, count: int, seed: int, noise_floor: float = NOISE_FLOOR, most_noise: float = MOST_NOISE
) -> tuple[Hyperparameters, ...]:
    """Draw samples of hyperparameters from their posterior distribution, given the points of a process. The same
    arguments give the same result.

    Args:
        posterior: an exact process. The Markov chain starts at its hyperparameters.
        count: number of samples.
        seed: seed of the chain.
        noise_floor: least noise variance, as in the fit: a share of the output's variance.
        most_noise: greatest noise variance, also as a share of the output's variance. If the process has more, the
            chain starts at the likeliest hyperparameters within this bound.
    """
    hyper = posterior.hyper
    options = FitOptions(
        hyper.linear_variance > 0, hyper.quadratic_variance > 0, noise_floor=noise_floor, most_noise=most_noise
    )
    evidence = Evidence(posterior.x, posterior.y, options, hyper.reflection)
    chain = _Chain(evidence, np.random.default_rng(seed))
    theta, hypers = evidence.theta(hyper), []
    with blas().limit(limits=1):
        if hyper.noise_variance > most_noise:
            theta = _with_less_noise(evidence, theta)
        level = chain.log_likelihood(theta)
        for update in range(1, BURN_IN + THINNING * count + 1):
            theta, level = chain.update(theta, level)
            if update > BURN_IN and (update - BURN_IN) % THINNING == 0:
                hypers.append(evidence.hyper(theta))
    return tuple(hypers)


def _with_less_noise(evidence: Evidence, theta: Array) -> Array:
    """Return the likeliest theta within the bounds of ``evidence``, which allow less noise than ``theta`` has. The
    searches start at several shorter length scales, because the function has to explain what was noise in ``theta``."""
    starts = [theta.copy() for _ in SHORTER]
    for start, shorter in zip(starts, SHORTER, strict=True):
        start[: evidence.d] -= shorter
    return min((minimum(evidence, start) for start in starts), key=lambda pair: pair[0])[1]


class _Chain:
    """Markov chain of theta, the logarithms of hyperparameters. Its stationary distribution is the posterior of theta
    given the points."""

    def __init__(self, evidence: Evidence, rng: np.random.Generator) -> None:
        self._evidence, self._rng = evidence, rng
        self._mean, self._std = evidence.prior.T

    def log_likelihood(self, theta: Array) -> float:
        """Return the log evidence at theta, without the priors of hyperparameters; -inf outside the bounds of a fit."""
        if (theta < self._evidence.lower).any() or (theta > self._evidence.upper).any():
            return -math.inf
        negative, _ = self._evidence(theta)
        z = (theta - self._mean) / self._std
        return 0.5 * float(z @ z) - negative

    def update(self, theta: Array, level: float) -> tuple[Array, float]:
        """Return the next theta of the chain and its log likelihood; ``level`` is the log likelihood of ``theta``."""
        rng, around = self._rng, theta - self._mean
        other = self._std * rng.standard_normal(len(theta))
        least = level + math.log(1 - rng.random())
        angle = rng.uniform(0, 2 * math.pi)
        low, high = angle - 2 * math.pi, angle
        while high - low > NARROWEST:
            candidate = self._mean + around * math.cos(angle) + other * math.sin(angle)
            if (log_likelihood := self.log_likelihood(candidate)) > least:
                return candidate, log_likelihood
            low, high = (angle, high) if angle < 0 else (low, angle)
            angle = rng.uniform(low, high)
        return theta, level
