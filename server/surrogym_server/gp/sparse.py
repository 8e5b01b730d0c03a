"""Processes with many points: a few inducing points represent all of them, and everything else stays the same.

m of the n points are chosen, Z, by pivoted Cholesky: each is the one that the others explain least. With V = L^-1 k(Z,
X), L L^T = k(Z, Z), and C = V V^T, the projected process (R&W (2006), section 8.3.4) predicts

    mean(x) = k(x, Z) L^-T (C + sigma_n^2 I)^-1 V y,
    var(x) = k(x, x) - k(x, Z) (F F^T)^-1 k(Z, x),  F = L chol(I + sigma_n^2 C^-1).

So it is an exact process of the m points with the factor F, the values y_Z = F F^T weights, and the noise sigma_n^2 L
C^-1 L^T, which is the remaining noise if n points are represented by m. It is served, stored, extended and sampled like
any other process. Away from Z its variance returns to the prior's.

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

MAX_EXACT = 2_000  # a process with more points is sparse
INDUCING = 1_000
NOISES = (1.0, 1e2)  # times the noise variance that was fitted
SHARE = 1e-12  # least share that all other points have in a prediction
EXPLAINED, BELOW_NOISE = 1e-10, 1e-3  # of the prior's and the noise variance: least variance to choose


@dataclass(frozen=True)
class Censored:
    """Points of which only a side is known: side * f(x) is at least side * y."""

    x: Tensor  # (k, d)
    y: Tensor  # (k,)
    side: Tensor  # (k,) 1 or -1

    def log_probability(self, posterior: Posterior) -> float:
        """Log probability of all sides, each by itself."""
        mean, variance = posterior.mean_and_variance(self.x)
        over = self.side * (mean - self.y) / (variance + posterior.hyper.noise_variance).sqrt()
        return float(torch.special.log_ndtr(over).sum())

    def misfit(self, posterior: Posterior) -> float:
        """Sum of squares of what the mean falls short of y on the side."""
        return float((self.side * (self.y - posterior.mean(self.x))).clamp_min(0).square().sum())


def condition_many(
    hypers: Sequence[Hyperparameters],
    x: Tensor,
    y: Tensor,
    censored: Censored | None = None,
    earlier: Posterior | None = None,
) -> Posterior:
    """Condition a process on x (n, d) and y (n,). Up to ``MAX_EXACT`` points this is exact, with the last
    hyperparameters.

    With more points it uses inducing points, and all points decide, because hyperparameters fitted to a subset may miss
    rare points. Each point is predicted from the others, and ``censored`` points are predicted as well. The density
    decides how large the noise is: inducing points leave errors that the fitted noise does not know. The mean squared
    error decides between the hyperparameters, each with its best noise. R&W (2006), section 5.4.2. An ``earlier``
    process through inducing points for the same x and y is compared with them.

    Raises:
        NumericalFailure: as ``condition``.
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
        NumericalFailure: as ``condition``.
    """
    return _projected(hyper, x, y, _pivots(hyper, x, most))


def pivots(hyper: Hyperparameters, x: Tensor, most: int) -> Tensor:
    """Numbers of at most ``most`` of the points x (n, d): each is the one that those before it explain least, (m,)."""
    return _pivots(hyper, x, most)[0]


def hardest(posterior: Posterior, x: Tensor, y: Tensor, most: int) -> Tensor:
    """Numbers of ``most`` of the points x (n, d), y (n,) that are hard for a process of them, (most,).

    Half are those that the others explain least, in the order of the pivoted Cholesky. The others have the largest
    residuals.
    """
    apart, _, _ = _pivots(posterior.hyper, x, most // 2)
    off = (y - posterior.mean(x)).abs().index_fill(0, apart, -1.0)
    return torch.cat([apart, off.topk(min(most, len(y)) - len(apart)).indices])


def _with_noises(hyper: Hyperparameters, x: Tensor, y: Tensor) -> Iterator[Posterior]:
    """The same inducing points with several noise variances."""
    pivots = _pivots(hyper, x)
    for noise in NOISES:
        yield _projected(replace(hyper, noise_variance=noise * hyper.noise_variance), x, y, pivots)


def _projected(hyper: Hyperparameters, x: Tensor, y: Tensor, pivots: tuple[Tensor, Tensor, Tensor]) -> Posterior:
    """The process through the inducing points of ``_pivots``."""
    points, v, left = pivots  # (m,), V (m, n), (n,)
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
    """Error and variance, noise included, of each of n points predicted from all others, (n,) each.

    Args:
        v: V = L^-1 K of the m inducing points and all n, (m, n).
        solid: factor of C + sigma_n^2 I, (m, m).
        residual: y less the mean at every point, (n,).
        noise: sigma_n^2.
        left: variance that the inducing points leave, (n,).
    """
    blocks = torch.split(v, BLOCK, dim=1)
    own = [torch.linalg.solve_triangular(solid, block, upper=False).square().sum(0) for block in blocks]
    others = (1 - torch.cat(own)).clamp_min(SHARE)
    return residual / others, noise / others + left


def _pivots(hyper: Hyperparameters, x: Tensor, most: int | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """Points in the order of their choice (m,), the rows V (m, n), and the variance that they leave at each (n,).

    At most ``most`` points are chosen, by default ``INDUCING``.
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
