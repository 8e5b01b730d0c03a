"""Hyperparameters by maximum marginal likelihood with priors (maximum a posteriori), L-BFGS with analytic gradients.

d log p(y) / d theta_j = 1/2 tr((beta beta^T - (K + sigma_n^2 I)^-1) dK/d theta_j); R&W (2006), eq. 5.9.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from torch import Tensor

from surrogym_server.gp.kernel import Hyperparameters, Reflection
from surrogym_server.gp.parameters import Array, FitOptions, Parameters
from surrogym_server.gp.posterior import Posterior, condition
from surrogym_server.gp.search import Evidence, blas, minimum
from surrogym_server.gp.sparse import hardest
from surrogym_server.gp.subsets import FEW, SOME, spread

NOISY = 1e-2  # noise variance at which the search of ``noisy_explanation`` starts, as a share of the output's variance
# With more points, a fit that starts at an earlier result also tries the default start only if the number of points is
# a multiple of 4.
MANY_POINTS = 24
# Stages of ``refine``: each is (greatest number of points, greatest number of iterations). Each stage starts near the
# optimum, so few iterations suffice.
REFINEMENTS = ((1_000, 20), (2_000, 10))
HARD, HARD_ITERATIONS = 1_000, 20  # ``refine_where_hard`` uses this many points and at most this many iterations
SHORTER = 0.5  # the logarithms of length scales are smaller by this much at the second start of a fit


@dataclass(frozen=True)
class Fitted:
    """Result of a fit: the posterior, its score (log evidence at the optimum, priors included), and the free parameters
    theta, from which a later fit can start."""

    posterior: Posterior
    score: float
    theta: Array


def fit(
    x: Tensor, y: Tensor, options: FitOptions, warm: Array | None = None, reflection: Reflection | None = None
) -> Fitted:
    """Fit a process to inputs x (n, d) and targets y (n,), both standardised. Runs on the CPU.

    Args:
        warm: logarithms of hyperparameters from an earlier fit, at which a search starts too; None for the default
            start only.
        reflection: symmetry of the functions to fit, or None.

    Raises:
        NumericalFailure: no jitter makes the covariance of the points positive definite.
    """
    objective = Evidence(x, y, options, reflection)
    with blas().limit(limits=1):
        starts = [*_starts(objective.default_start, warm, len(y)), *objective.noisy_starts]
        fits = [minimum(objective, start) for start in starts]
    value, theta = min(fits, key=lambda pair: pair[0])
    return Fitted(condition(objective.hyper(theta), x, y), -value, theta)


def fit_some(x: Tensor, y: Tensor, options: FitOptions, theta: Array, reflection: Reflection | None = None) -> Array:
    """Fit hyperparameters to at most ``SOME`` (400) of the points x (n, d), y (n,), and return their logarithms. The
    argument ``theta`` contains logarithms of hyperparameters that were fitted to fewer points.

    The optimum changes with more points: they show structure that looks like noise with fewer points. So the search has
    two starts: ``theta``, and one with shorter length scales and little noise.
    """
    rows = spread(len(y), SOME)
    objective = Evidence(x[rows], y[rows], options, reflection)
    shorter = theta.copy()
    shorter[: objective.d] -= SHORTER
    shorter[-1] = objective.default_start[-1]
    with blas().limit(limits=1):
        _, theta = min((minimum(objective, start) for start in (theta, shorter)), key=lambda pair: pair[0])
    return theta


def refine(
    x: Tensor, y: Tensor, options: FitOptions, theta: Array, reflection: Reflection | None = None
) -> tuple[Hyperparameters, ...]:
    """Refine hyperparameters on more of the points x (n, d), y (n,), starting from ``theta``, the result of
    ``fit_some``.

    There are several stages. Each uses more points and fewer iterations than the one before, which limits the time (see
    ``gp.subsets``).

    Returns:
        The hyperparameters of ``theta`` and of each stage, in that order; the last stage saw the most points.
    """
    thetas, points = [theta], min(len(y), SOME)
    with blas().limit(limits=1):
        for most, iterations in REFINEMENTS:
            if len(y) > points:
                rows = spread(len(y), most)
                objective = Evidence(x[rows], y[rows], replace(options, max_iterations=iterations), reflection)
                thetas.append(minimum(objective, thetas[-1])[1])
                points = len(rows)
    parameters = Parameters(x.shape[1], options, reflection)
    return tuple(parameters.hyper(theta) for theta in thetas)


def refine_where_hard(posterior: Posterior, x: Tensor, y: Tensor, options: FitOptions) -> Hyperparameters:
    """Refine the hyperparameters of a process of many points x (n, d), y (n,) on the points that it predicts worst.

    A random subset of the points hardly constrains a small region where the function is steep, because few of its
    points lie there. The search starts with a noise variance equal to the mean squared error at the points used.
    """
    rows = hardest(posterior, x, y, HARD)
    error = float((y[rows] - posterior.mean(x[rows])).square().mean())
    start = replace(posterior.hyper, noise_variance=max(error, options.noise_floor))
    objective = Evidence(x[rows], y[rows], replace(options, max_iterations=HARD_ITERATIONS), start.reflection)
    with blas().limit(limits=1):
        _, theta = minimum(objective, objective.theta(start))
    return objective.hyper(theta)


def noisy_explanation(posterior: Posterior, options: FitOptions) -> float:
    """Search for hyperparameters from a start with much noise. Return the noise variance that is found if the points
    are at least as likely with it as with the posterior's own hyperparameters, otherwise the posterior's own noise
    variance.

    This finds noise that a fit missed because it started at an earlier result and stayed at an optimum without noise.
    At most ``FEW`` (150) of the points are used.
    """
    rows = spread(len(posterior.y), FEW)
    objective = Evidence(posterior.x[rows], posterior.y[rows], options, posterior.hyper.reflection)
    start = objective.default_start.copy()
    start[-1] = math.log(NOISY)
    with blas().limit(limits=1):
        value, theta = minimum(objective, start)
        own, _ = objective(objective.theta(posterior.hyper))
    return float(np.exp(theta[-1])) if value <= own else posterior.hyper.noise_variance


def _starts(default: Array, warm: Array | None, points: int) -> Sequence[Array]:
    """Return the thetas (logarithms of hyperparameters) at which a fit to a number of points starts to search.

    If there is no ``warm``, the result of an earlier fit, the search starts at ``default``. With at most
    ``MANY_POINTS`` (24) points there are many optima and a fit is fast, so both are used. With more points, ``default``
    is used in addition to ``warm`` only if ``points`` is a multiple of 4.
    """
    if warm is None:
        return (default,)
    return (warm,) if points > MANY_POINTS and points % 4 else (warm, default)
