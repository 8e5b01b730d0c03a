"""Effect of further real steps on the deviations of last layers, before they are taken.

With F the factor of a regression's covariance at some points (``Regression.factor``), observing x_i shrinks every
covariance by a product of rank one, and needs no value of y:

    C'(x_a, x_b) = C(x_a, x_b) - r_a r_b,  r_a = C(x_a, x_i) / sqrt(C(x_i, x_i) + s^2),  C = F F^T.

For several members this treats the mixture as one normal distribution. References as in the family of processes: A.
Krause, A. Singh, C. Guestrin (2008), JMLR 9, section 2 and algorithm 1; D. Cohn (NIPS 1993).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from surrogym_server.models.abilities import OutputOutlook, PathOutlook

FINEST = 1e10  # largest ratio of a variance to the squared tolerance: beyond it a covariance is rounding


@dataclass(frozen=True)
class LayerOutlook(OutputOutlook):
    """Outlook of one output at m candidates and r reference points."""

    factor: Tensor  # F (m + r, w), in scales
    observed: Tensor  # rows r of the t points assumed observed (t, m + r)
    variance: Tensor  # (m + r,) in squared scales
    noise: float  # variance, in squared scales
    scale: float
    learns: Tensor  # (m,) bool

    @classmethod
    def of(cls, factor: Tensor, noise: float, scale: float, learns: Tensor, spans: tuple[int, int]) -> LayerOutlook:
        """Build it from F (m + r + t, w): m candidates and r reference points, the ends of which are ``spans``, and t
        points assumed observed."""
        variance = factor.square().sum(-1)
        whole = cls(factor, factor.new_zeros(0, len(factor)), variance, noise, scale, learns)
        for index in range(spans[1], len(factor)):
            whole = whole.observe(index)
        end = spans[1]
        return cls(factor[:end], whole.observed[:, :end], whole.variance[:end], noise, scale, learns[: spans[0]])

    @property
    def deviation(self) -> Tensor:
        return self.scale * self.variance[: len(self.learns)].sqrt()

    def reduction(self, weights: Tensor) -> Tensor:
        """sum_r w_r C(x_r, x)^2 / (C(x, x) + s^2)."""
        m = len(self.learns)
        shared = self.factor[m:] @ self.factor[:m].T - self.observed[:, m:].T @ self.observed[:, :m]
        reduced: Tensor = self.scale**2 * (weights @ shared.square()) / (self.variance[:m] + self.noise)
        return reduced

    def observe(self, index: int) -> LayerOutlook:
        if not self.learns[index]:
            return self
        shared = self.factor @ self.factor[index] - self.observed.T @ self.observed[:, index]
        row = shared / (self.variance[index] + self.noise).sqrt()
        variance = (self.variance - row.square()).clamp_min(0)
        return replace(self, observed=torch.cat([self.observed, row[None]]), variance=variance)


@dataclass(frozen=True)
class LayerAlongPaths(PathOutlook):
    """Outlook of one output along paths."""

    factor: Tensor  # F (b, T, w), in the output's unit
    learns: Tensor  # (b, T) bool

    @property
    def deviation(self) -> Tensor:
        return self.factor.square().sum(-1).sqrt()

    def information(self, weight: Tensor, tolerance: float) -> Tensor:
        """1/2 log det(1 + W C W / tau^2) of all leading parts of C (b, T, T)."""
        weighted = self.factor * weight[..., None]
        covariance = weighted @ weighted.mT
        largest = float(covariance.diagonal(dim1=-2, dim2=-1).max())
        ratio = min(1 / tolerance**2, FINEST / max(largest, torch.finfo(covariance.dtype).tiny))
        one = torch.eye(weight.shape[1], dtype=weight.dtype, device=weight.device)
        factor: Tensor = torch.linalg.cholesky(one + ratio * covariance)
        return factor.diagonal(dim1=-2, dim2=-1).log().cumsum(-1)
