"""Exact posterior of a Gaussian process (eq. 6 and 7 of the AUR paper, with the inverses that the paper omits).

mean(x) = k(x, X) (K + sigma_n^2 I)^-1 y,  var(x) = k(x, x) - |L^-1 k(X, x)|^2 with L L^T = K + sigma_n^2 I.
The variance is that of the function, without noise; it is computed by a triangular solve, never through an inverse.
Reference: Rasmussen and Williams (2006), algorithm 2.1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from surrogym_server.errors import NumericalFailure
from surrogym_server.gp.kernel import Hyperparameters, covariance, variance

MAX_JITTER = 1e-4
BLOCK = 16_384  # number of rows predicted at once, which bounds the memory


@dataclass(frozen=True)
class LeftOut:
    """Accuracy of leave-one-out predictions: each point of a process is predicted from all other points."""

    error: float  # root mean square leave-one-out error, in units of y
    within_one: float  # share of the points whose error is at most one predictive standard deviation
    within_two: float  # share of the points whose error is at most two predictive standard deviations
    log_density: float  # mean over the points of the log predictive density of the target

    @classmethod
    def of(cls, error: Tensor, variance: Tensor) -> LeftOut:
        """Compute the accuracy of n predictions from their errors (n,) and their predictive variances (n,), noise
        included."""
        size, std = error.abs(), variance.sqrt()
        one, two = (float((size <= width * std).double().mean()) for width in (1, 2))
        log_density = -0.5 * float((size.square() / variance + (2 * math.pi * variance).log()).mean())
        return cls(float(size.square().mean().sqrt()), one, two, log_density)


@dataclass(frozen=True)
class Sparse:
    """Summary of the many points to which a process with inducing points was fitted."""

    points: int  # number of points that the process was fitted to
    # Standard deviation of the points given the inducing points, as a share of their prior standard deviation; both are
    # root mean squares over all points.
    unexplained: float
    left_out: LeftOut  # accuracy at the points that the process was fitted to


@dataclass(frozen=True)
class Posterior:
    """A Gaussian process conditioned on n points. It contains everything that predictions need, so that nothing is
    computed again after loading a model from a file."""

    hyper: Hyperparameters
    x: Tensor  # (n, d) inputs of the points
    y: Tensor  # (n,) standardised targets
    factor: Tensor  # (n, n) lower Cholesky factor of K + (sigma_n^2 + jitter) I
    weights: Tensor  # (n,) beta, the weights of the points in the mean
    jitter: float  # number that had to be added to the diagonal of the covariance matrix to factor it, usually 0
    sparse: Sparse | None = None  # None if the n points are all samples; otherwise they are inducing points

    def mean(self, x: Tensor) -> Tensor:
        """Return the posterior mean (m,) at x (m, d)."""
        return covariance(self.hyper, x, self.x) @ self.weights

    def mean_and_variance(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return the posterior mean and the variance without noise at x (m, d), each (m,)."""
        means, variances = [], []
        for block in torch.split(x, BLOCK):
            k = covariance(self.hyper, block, self.x)
            v = torch.linalg.solve_triangular(self.factor, k.T, upper=False)
            means.append(k @ self.weights)
            variances.append((variance(self.hyper, block) - v.square().sum(0)).clamp_min(0))
        return torch.cat(means), torch.cat(variances)

    def joint_covariance(self, x: Tensor) -> Tensor:
        """Return the posterior covariances (b, m, m), without noise, of m points with each other, for each of b sets of
        points x (b, m, d)."""
        sets, points, _ = x.shape
        k = covariance(self.hyper, x.flatten(0, 1), self.x)
        v = torch.linalg.solve_triangular(self.factor, k.T, upper=False).reshape(-1, sets, points).transpose(0, 1)
        joint: Tensor = covariance(self.hyper, x, x) - v.mT @ v
        return joint

    @property
    def log_evidence(self) -> float:
        """Log marginal likelihood of the points, without priors of hyperparameters; Rasmussen and Williams (2006), eq.
        2.30."""
        roots = self.factor.diagonal().log().sum()
        return -float(0.5 * (self.y @ self.weights) + roots) - 0.5 * len(self.y) * math.log(2 * math.pi)

    @property
    def points(self) -> int:
        """Number of points that the process was fitted to. It is n, or larger if the process has n inducing points."""
        return len(self.y) if self.sparse is None else self.sparse.points

    @property
    def left_out(self) -> LeftOut:
        """Accuracy with which each of the points that the process was fitted to is predicted from all others."""
        if self.sparse is not None:
            return self.sparse.left_out
        mean, variance = self.leave_one_out()
        return LeftOut.of(mean - self.y, variance)

    def leave_one_out(self) -> tuple[Tensor, Tensor]:
        """Return the mean and variance, noise included, of predicting each target in y from all other points, (n,)
        each; Rasmussen and Williams (2006), eq. 5.12."""
        precision = torch.cholesky_inverse(self.factor).diagonal()
        return self.y - self.weights / precision, 1 / precision

    @property
    def noise_seen(self) -> float | None:
        """Noise variance estimated from points with equal inputs; None if all inputs differ."""
        equal = (self.x[:, None] == self.x).all(-1).triu(1)
        if not bool(equal.any()):
            return None
        return 0.5 * float((self.y[:, None] - self.y)[equal].square().mean())

    def extend(self, x: Tensor, y: Tensor) -> Posterior:
        """Return the process conditioned on one more point, x (d,) and y (). This adds a row to the Cholesky factor and
        takes O(n^2) time."""
        k = covariance(self.hyper, x[None], self.x)
        row = torch.linalg.solve_triangular(self.factor, k.T, upper=False).T
        pivot = variance(self.hyper, x[None]) + self.hyper.noise_variance + self.jitter - row.square().sum(1)
        pivot = pivot.clamp_min(self.hyper.noise_variance).sqrt()
        n = self.x.shape[0]
        factor = torch.zeros(n + 1, n + 1, dtype=self.factor.dtype, device=self.factor.device)
        factor[:n, :n], factor[n, :n], factor[n, n] = self.factor, row[0], pivot[0]
        y = torch.cat([self.y, y.reshape(1)])
        x = torch.cat([self.x, x[None]])
        return replace(self, x=x, y=y, factor=factor, weights=_weights(factor, y))


def condition(hyper: Hyperparameters, x: Tensor, y: Tensor) -> Posterior:
    """Condition a process on x (n, d) and y (n,).

    Raises:
        NumericalFailure: the covariance matrix can't be factored, even with a jitter of 1e-4 of its mean diagonal
            entry.
    """
    k = covariance(hyper, x, x)
    k.diagonal().add_(hyper.noise_variance)
    factor, jitter = factorise(k)
    return Posterior(hyper, x, y, factor, _weights(factor, y), jitter)


def factorise(k: Tensor) -> tuple[Tensor, float]:
    """Return the lower Cholesky factor of k (n, n), and the jitter that had to be added to its diagonal.

    The jitter is 0, or if that fails 1e-10 of the mean diagonal, increased tenfold until k can be factored. The factor
    is stored in memory row by row, as after loading a model from a file. Stored column by column, as LAPACK returns it,
    it would give predictions that differ in the last bits from those of the loaded model.

    Raises:
        NumericalFailure: k can't be factored, even with a jitter of ``MAX_JITTER`` of its mean diagonal.
    """
    factor, info = torch.linalg.cholesky_ex(k)
    if not bool(info):
        return factor.contiguous(), 0.0
    scale, relative = float(k.diagonal().mean()), 1e-10
    while relative <= MAX_JITTER:
        factor, info = torch.linalg.cholesky_ex(
            k + relative * scale * torch.eye(len(k), dtype=k.dtype, device=k.device)
        )
        if not bool(info):
            return factor.contiguous(), relative * scale
        relative *= 10
    raise NumericalFailure(
        f"the covariance matrix of {len(k)} samples is not positive definite, even with {MAX_JITTER:g} of its mean "
        "diagonal entry added to the diagonal; look for extreme outliers in the samples"
    )


def _weights(factor: Tensor, y: Tensor) -> Tensor:
    return torch.cholesky_solve(y[:, None], factor)[:, 0]
