"""Processes with many points: a few inducing points represent them all, with the same interface as an exact process.

m of the n points are chosen, Z, by pivoted Cholesky: each is the one that the others explain least. With V = L^-1 k(Z,
X), L L^T = k(Z, Z), and C = V V^T, the projected process (R&W (2006), section 8.3.4) predicts

    mean(x) = k(x, Z) L^-T (C + sigma_n^2 I)^-1 V y,
    var(x) = k(x, x) - k(x, Z) (F F^T)^-1 k(Z, x),  F = L chol(I + sigma_n^2 C^-1).

So it is an exact process of the m points with the factor F, the values y_Z = F F^T weights, and the noise sigma_n^2 L
C^-1 L^T, which is the noise that remains if m points represent n. It is served, stored, extended and sampled like any
other process. Far from Z its variance returns to the prior's.

Its m values are not data, because each represents many points. So leave-one-out errors are those of the n points, with
h_i = (V^T (C + sigma_n^2 I)^-1 V)_ii:

    y_i - mean_{-i} = (y_i - mean(x_i)) / (1 - h_i),  var_{-i} = sigma_n^2 / (1 - h_i) + what Z leaves of k(x_i, x_i).

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
INDUCING = 1_000  # greatest number of inducing points, unless the caller gives another
NOISES = (1.0, 1e2)  # noise variances to try, as multiples of the fitted one
SHARE = 1e-12  # lower limit of the share of all other points in the prediction at a point
# No further inducing point is chosen below this unexplained variance, as a share of the prior's variance and of the
# noise variance.
EXPLAINED, BELOW_NOISE = 1e-10, 1e-3


@dataclass(frozen=True)
class Censored:
    """Points for which only a bound of f is known: side * f(x) is at least side * y."""

    x: Tensor  # (k, d) inputs of the points
    y: Tensor  # (k,) the bounds
    side: Tensor  # (k,) 1 if y is a lower bound of f(x), -1 if it is an upper bound

    def log_probability(self, posterior: Posterior) -> float:
        """Return the sum of the log probabilities that each bound holds, point by point."""
        mean, variance = posterior.mean_and_variance(self.x)
        over = self.side * (mean - self.y) / (variance + posterior.hyper.noise_variance).sqrt()
        return float(torch.special.log_ndtr(over).sum())

    def misfit(self, posterior: Posterior) -> float:
        """Return the sum of squares by which the mean violates the bounds."""
        return float((self.side * (self.y - posterior.mean(self.x))).clamp_min(0).square().sum())


def condition_many(
    hypers: Sequence[Hyperparameters],
    x: Tensor,
    y: Tensor,
    censored: Censored | None = None,
    earlier: Posterior | None = None,
) -> Posterior:
    """Condition a process on x (n, d) and y (n,); with more than ``MAX_EXACT`` points through inducing points.

    Up to ``MAX_EXACT`` points the result is exact, with the last hyperparameters. With more, all points select the
    hyperparameters, because a fit to a subset may miss rare points: each point is predicted from the others, and each
    ``censored`` one as well. The predictive density selects the noise, since inducing points leave errors that the
    fitted noise does not contain. Then the mean squared error selects the hyperparameters. R&W (2006), section 5.4.2.

    Args:
        hypers: candidates, the last one fitted to the most points.
        censored: points with a bound only, or None.
        earlier: another process of the same points, compared with the candidates, or None.

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
    """Condition a process on x (n, d) and y (n,) through at most ``most`` inducing points, by default ``INDUCING``, in
    O(n m^2).

    Raises:
        NumericalFailure: no jitter makes a covariance positive definite.
    """
    return _projected(hyper, x, y, _pivots(hyper, x, most))


def pivots(hyper: Hyperparameters, x: Tensor, most: int) -> Tensor:
    """Return indices (m,) of at most ``most`` of the points x (n, d), in the order of choice: each is the point
    that the earlier ones explain least."""
    return _pivots(hyper, x, most)[0]


def hardest(posterior: Posterior, x: Tensor, y: Tensor, most: int) -> Tensor:
    """Return indices of at most ``most`` of the points x (n, d), y (n,) that a process of them predicts worst.

    Half are those that the others explain least, in the order of the pivoted Cholesky. The others have the largest
    residuals.
    """
    apart, _, _ = _pivots(posterior.hyper, x, most // 2)
    off = (y - posterior.mean(x)).abs().index_fill(0, apart, -1.0)
    return torch.cat([apart, off.topk(min(most, len(y)) - len(apart)).indices])


def _with_noises(hyper: Hyperparameters, x: Tensor, y: Tensor) -> Iterator[Posterior]:
    """Yield the process through inducing points, once for each noise variance of ``NOISES``; the points are the
    same."""
    pivots = _pivots(hyper, x)
    for noise in NOISES:
        yield _projected(replace(hyper, noise_variance=noise * hyper.noise_variance), x, y, pivots)


def _projected(hyper: Hyperparameters, x: Tensor, y: Tensor, pivots: tuple[Tensor, Tensor, Tensor]) -> Posterior:
    """Return the process of x (n, d) and y (n,) through inducing points; ``pivots`` is the result of ``_pivots``."""
    points, v, left = pivots  # indices (m,), V (m, n), remaining variances (n,)
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
    """Return error and variance, noise included, of each of n points predicted from all others, (n,) each.

    Args:
        v: V = L^-1 K of the m inducing points and all n, (m, n).
        solid: Cholesky factor of C + sigma_n^2 I, (m, m).
        residual: y less the mean at every point, (n,).
        noise: sigma_n^2.
        left: variance that the inducing points leave unexplained, (n,).
    """
    blocks = torch.split(v, BLOCK, dim=1)
    own = [torch.linalg.solve_triangular(solid, block, upper=False).square().sum(0) for block in blocks]
    others = (1 - torch.cat(own)).clamp_min(SHARE)
    return residual / others, noise / others + left


def _pivots(hyper: Hyperparameters, x: Tensor, most: int | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """Choose at most ``most`` inducing points of x (n, d), by default ``INDUCING``, by pivoted Cholesky.

    Returns:
        Indices of the points in the order of their choice (m,), the rows V (m, n), and the variance that they leave
        unexplained at each point (n,).
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
