"""Joint latent posterior of a process at fixed points, and how observations at some of them would change it.

Observing x_i shrinks every covariance by a product of rank one and needs no value of y:

    k'(x_a, x_b) = k(x_a, x_b) - r_a r_b,  r_a = k(x_a, x_i) / sqrt(k(x_i, x_i) + sigma_n^2),

with k the posterior covariance; r is the next row of L^-1 k(X, x). An observation costs O(n m): nothing is refitted.
Reference: Rasmussen and Williams (2006), section 2.2; Krause, Singh, Guestrin (JMLR 2008), algorithm 1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from surrogym_server.gp.kernel import Hyperparameters, covariance, variance
from surrogym_server.gp.posterior import Posterior


@dataclass(frozen=True)
class Joint:
    """Joint posterior distribution of a process at m fixed points, in the standardised units of the process."""

    hyper: Hyperparameters
    x: Tensor  # (m, d) inputs of the m points
    whitened: Tensor  # (n, m) L^-1 k(X, x), with L the Cholesky factor of the process
    # (p, m) for each of p points that are assumed observed, its covariances with the m points divided by the standard
    # deviation of the observation.
    observed: Tensor
    variance: Tensor  # (m,) variance at the points, without noise
    noise: float

    @classmethod
    def of(cls, posterior: Posterior, x: Tensor) -> Joint:
        """Return the joint posterior at points x (m, d), given only the samples on which the process is conditioned."""
        k = covariance(posterior.hyper, posterior.x, x)
        whitened = torch.linalg.solve_triangular(posterior.factor, k, upper=False)
        latent = (variance(posterior.hyper, x) - whitened.square().sum(0)).clamp_min(0)
        noise = posterior.hyper.noise_variance + posterior.jitter
        return cls(posterior.hyper, x, whitened, x.new_zeros(0, len(x)), latent, noise)

    def between(self, a: slice, b: slice) -> Tensor:
        """Return the posterior covariances (|a|, |b|) of the points in slice a with those in slice b."""
        prior = covariance(self.hyper, self.x[a], self.x[b])
        explained = self.whitened[:, a].T @ self.whitened[:, b] + self.observed[:, a].T @ self.observed[:, b]
        return prior - explained

    def row(self, index: int) -> Tensor:
        """Return the posterior covariances (m,) of point ``index`` with all points, divided by the standard deviation
        of an observation at this point, noise included."""
        shared = self.between(slice(index, index + 1), slice(None))[0]
        return shared / (self.variance[index] + self.noise).sqrt()

    def observe(self, index: int) -> Joint:
        """Return the joint posterior as if point ``index`` had been observed too, in addition to earlier
        observations."""
        row = self.row(index)
        shrunk = (self.variance - row.square()).clamp_min(0)
        return replace(self, observed=torch.cat([self.observed, row[None]]), variance=shrunk)
