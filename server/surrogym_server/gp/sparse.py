"""Processes with many points: a few inducing points represent them all, with the same interface as an exact process.

m of the n points X are chosen as inducing points Z, by pivoted Cholesky: each is the point that those chosen before
explain least. With V = L^-1 k(Z, X), L L^T = k(Z, Z), and C = V V^T, the projected process (R&W (2006), section 8.3.4)
predicts

    mean(x) = k(x, Z) L^-T (C + sigma_n^2 I)^-1 V y,
    var(x) = k(x, x) - k(x, Z) (F F^T)^-1 k(Z, x),  F = L chol(I + sigma_n^2 C^-1).

So it is an exact process of the m points with the factor F, the values y_Z = F F^T weights, and the noise covariance
sigma_n^2 L C^-1 L^T, which is the noise that remains if m points represent n. It is served, stored, extended and
sampled like any other process. Far from Z its variance returns to the prior's.

Its m values y_Z are not measured, because each represents many points. So leave-one-out errors are those of the n
points, with h_i = (V^T (C + sigma_n^2 I)^-1 V)_ii and the variance v_i of point i given the values at Z:

    y_i - mean_{-i} = (y_i - mean(x_i)) / (1 - h_i),  var_{-i} = sigma_n^2 / (1 - h_i) + v_i.

References: Fine and Scheinberg (2001) for the choice of Z; Seeger, Williams, Lawrence (2003) for the projected process.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from surrogym_server.gp.kernel import Hyperparameters, covariance, variance
from surrogym_server.gp.posterior import BLOCK, LeftOut, Posterior, Sparse, condition, factorise

MAX_EXACT = 2_000  # a process with more points uses inducing points
INDUCING = 1_000  # greatest number of inducing points, unless the caller gives another number
NOISES = (1.0, 1e2)  # noise variances that ``condition_many`` tries, as multiples of the fitted noise variance
SHARE = 1e-12  # lower limit of 1 - h_i in the leave-one-out formulas, against a division by 0
# No further inducing point is chosen if the unexplained variance of every point is at most the first share of the mean
# prior variance, or at most the second share of the noise variance.
EXPLAINED, BELOW_NOISE = 1e-10, 1e-3


@dataclass(frozen=True)
class Censored:
    """Points x at which only a bound y of the function f is known: side * f(x) is at least side * y, with side 1
    or -1."""

    x: Tensor  # (k, d) inputs of the points
    y: Tensor  # (k,) known bound of the function's value at each of k points
    side: Tensor  # (k,) 1 if y is a lower bound of f(x), -1 if it is an upper bound

    def log_probability(self, posterior: Posterior) -> float:
        """Return the sum over the points of the log probability, under a posterior, that the bound at the point
        holds."""
        mean, variance = posterior.mean_and_variance(self.x)
        over = self.side * (mean - self.y) / (variance + posterior.hyper.noise_variance).sqrt()
        return float(torch.special.log_ndtr(over).sum())

    def misfit(self, posterior: Posterior) -> float:
        """Return the sum of the squared amounts by which the posterior mean violates the bounds."""
        return float((self.side * (self.y - posterior.mean(self.x))).clamp_min(0).square().sum())


def condition_many(
    hypers: Sequence[Hyperparameters],
    x: Tensor,
    y: Tensor,
    censored: Censored | None = None,
    earlier: Posterior | None = None,
) -> Posterior:
    """Condition a process on x (n, d) and y (n,); with more than ``MAX_EXACT`` points through inducing points.

    Up to ``MAX_EXACT`` points the result is exact, with the last hyperparameters. With more, candidates are compared by
    their predictions of each point from all others and of the ``censored`` points, because a fit to a subset may miss
    rare points. First, the noise of each candidate is chosen by the density of its predictions, because inducing points
    cause errors that the fitted noise does not include. Then the candidate with the least squared errors is chosen.
    Rasmussen and Williams (2006), section 5.4.2.

    Args:
        hypers: candidate hyperparameters. The last one was fitted to the most points.
        censored: points with a bound only, or None.
        earlier: another posterior of the same points that is also a candidate, or None.

    Raises:
        NumericalFailure: no jitter makes a covariance positive definite.
    """
    if len(y) <= MAX_EXACT:
        return condition(hypers[-1], x, y)
    censor = censored or Censored(x[:0], y[:0], y[:0])

    def density(posterior: Posterior) -> float:
        return len(y) * posterior.left_out.log_density + censor.log_probability(posterior)

    def misfit(posterior: Posterior) -> float:
        return len(y) * posterior.left_out.error**2 + censor.misfit(posterior)

    posteriors = [max(_with_noises(hyper, x, y), key=density) for hyper in hypers]
    return min(posteriors if earlier is None else [earlier, *posteriors], key=misfit)


def condition_sparse(hyper: Hyperparameters, x: Tensor, y: Tensor, most: int | None = None) -> Posterior:
    """Condition a process on x (n, d) and y (n,) through m inducing points, at most ``most`` or by default
    ``INDUCING``, in O(n m^2) time.

    Raises:
        NumericalFailure: no jitter makes a covariance positive definite.
    """
    return _projected(hyper, x, y, _pivots(hyper, x, most))


def pivots(hyper: Hyperparameters, x: Tensor, most: int) -> Tensor:
    """Choose at most ``most`` of the points x (n, d): each is the point whose prior variance, given the function's
    values at the points chosen before, is greatest. Return their indices (m,) in this order."""
    return _pivots(hyper, x, most)[0]


def hardest(posterior: Posterior, x: Tensor, y: Tensor, most: int) -> Tensor:
    """Return the indices of at most ``most`` of the points x (n, d), y (n,): those that the posterior, which was fitted
    to all of them, predicts worst.

    The first half is chosen by pivoted Cholesky: each is the point whose prior variance, given the function's values at
    the points chosen before, is greatest. The second half are the points with the largest residuals.
    """
    apart, _, _ = _pivots(posterior.hyper, x, most // 2)
    off = (y - posterior.mean(x)).abs().index_fill(0, apart, -1.0)
    return torch.cat([apart, off.topk(min(most, len(y)) - len(apart)).indices])


def _with_noises(hyper: Hyperparameters, x: Tensor, y: Tensor) -> Iterator[Posterior]:
    """Yield the process of x (n, d) and y (n,) through inducing points, once for each factor in the list ``NOISES``, by
    which the noise variance is multiplied. All use the same inducing points."""
    pivots = _pivots(hyper, x)
    for noise in NOISES:
        yield _projected(replace(hyper, noise_variance=noise * hyper.noise_variance), x, y, pivots)


def _projected(hyper: Hyperparameters, x: Tensor, y: Tensor, pivots: tuple[Tensor, Tensor, Tensor]) -> Posterior:
    """Return the process of x (n, d) and y (n,) through inducing points. ``pivots`` are the indices of the inducing
    points among the rows of x, and other results of choosing them, as ``_pivots`` returns them."""
    # Pivoted Cholesky: indices of m inducing points (m,), factor V (m, n), variances that V does not explain (n,).
    points, v, left = pivots
    inducing = x[points]
    lower = v[:, points].T.tril()
    noise = hyper.noise_variance
    gram = v @ v.T
    solid, _ = factorise(gram + noise * torch.eye(len(gram), dtype=x.dtype, device=x.device))
    whitened = torch.cholesky_solve((v @ y)[:, None], solid)
    weights = torch.linalg.solve_triangular(lower.T, whitened, upper=True)[:, 0]
    inverse = torch.cholesky_inverse(factorise(gram)[0])
    inner, _ = factorise(torch.eye(len(gram), dtype=x.dtype, device=x.device) + noise * 0.5 * (inverse + inverse.T))
    factor = lower @ inner
    values = factor @ (factor.T @ weights)
    residual = y - v.T @ whitened[:, 0]
    left_out = LeftOut.of(*_left_out(v, solid, residual, noise, left))
    sparse = Sparse(len(y), float((left.mean() / variance(hyper, x).mean()).sqrt()), left_out)
    return Posterior(hyper, inducing, values, factor, weights, 0.0, sparse)


def _left_out(v: Tensor, solid: Tensor, residual: Tensor, noise: float, left: Tensor) -> tuple[Tensor, Tensor]:
    """Return the errors and the variances (noise included) of predictions of each of n points from all others, (n,)
    each.

    Args:
        v: V = L^-1 K, with the covariances K of the m inducing points with all n points, (m, n).
        solid: Cholesky factor of V V^T + sigma_n^2 I, (m, m).
        residual: target less posterior mean at each point, (n,).
        noise: noise variance sigma_n^2.
        left: variance that the inducing points leave unexplained, (n,).
    """
    blocks = torch.split(v, BLOCK, dim=1)
    own = [torch.linalg.solve_triangular(solid, block, upper=False).square().sum(0) for block in blocks]
    others = (1 - torch.cat(own)).clamp_min(SHARE)
    return residual / others, noise / others + left


def _pivots(hyper: Hyperparameters, x: Tensor, most: int | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """Choose at most ``most`` inducing points of x (n, d), by default ``INDUCING``, by pivoted Cholesky.

    Returns:
        Indices of the inducing points in the order in which they were chosen (m,); the rows V (m, n) of the partial
        Cholesky factor; and the variance of each point that the inducing points leave unexplained (n,).
    """
    left, prior = variance(hyper, x), float(variance(hyper, x).mean())
    enough = max(BELOW_NOISE * hyper.noise_variance, EXPLAINED * prior)
    rows, points = x.new_empty(min(INDUCING if most is None else most, len(x)), len(x)), []
    for count in range(len(rows)):
        pivot = int(left.argmax())
        if count and float(left[pivot]) <= enough:
            break
        row = covariance(hyper, x[pivot : pivot + 1], x)[0] - rows[:count, pivot] @ rows[:count]
        rows[count] = row / left[pivot].sqrt()
        left = (left - rows[count].square()).clamp_min_(0)
        left[pivot] = 0.0
        points.append(pivot)
    return torch.tensor(points, device=x.device), rows[: len(points)], left
