"""A process that predicts nearly the same mean from fewer points, so that its mean costs less.

The points are chosen by f-greedy interpolation (De Marchi, Schaback and Wendland 2005): the next one is where the mean
that the chosen points give is furthest from the mean of all points. In the Newton basis of the kernel, each point costs
a column of the covariance matrix.
"""

from __future__ import annotations

import torch

from surrogym_server.gp.kernel import covariance, variance
from surrogym_server.gp.posterior import Posterior

# Largest error of the mean at the samples, as a share of the mean's standard deviation there
TOLERANCE = 1e-4
LEAST_PIVOT = 1e-10  # a point whose variance given the chosen points is a smaller share of the largest is not chosen


def thinned(posterior: Posterior) -> Posterior:
    """Return a process that interpolates a process's mean at some of its n points, with an error of at most
    ``TOLERANCE`` standard deviations of the mean at the others; or the process itself if that takes all points.

    Only means of the result stand for those of the process: its variances are those of fewer points without noise.
    """
    x, hyper = posterior.x, posterior.hyper
    k = covariance(hyper, x, x)
    mean = k @ posterior.weights
    left, unexplained = mean.clone(), variance(hyper, x)
    least, tolerance = LEAST_PIVOT * float(unexplained.max()), TOLERANCE * float(mean.std(correction=0))
    basis, coefficients, chosen = torch.zeros_like(k), torch.zeros_like(mean), []
    for count in range(len(x)):
        size = torch.where(unexplained > least, left.abs(), 0.0)
        i = int(size.argmax())
        if not size[i] > tolerance:
            break
        pivot = unexplained[i].sqrt()
        column = (k[:, i] - basis[:, :count] @ basis[i, :count]) / pivot
        basis[:, count], coefficients[count] = column, left[i] / pivot
        left, unexplained = left - coefficients[count] * column, unexplained - column.square()
        unexplained[i] = 0.0
        chosen.append(i)
    if not 0 < len(chosen) < len(x):
        return posterior
    factor = basis[chosen, : len(chosen)].tril().contiguous()
    weights = torch.linalg.solve_triangular(factor.T, coefficients[: len(chosen), None], upper=True)[:, 0]
    return Posterior(hyper, x[chosen], mean[chosen], factor, weights, 0.0)
