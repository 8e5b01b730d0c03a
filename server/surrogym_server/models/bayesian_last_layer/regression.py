"""Regression: the last layers of some outputs in their own units, as a model serves them.

K members, p outputs, m points, k features. Member and output are one leading dimension (K p) of the features, in this
order. The weights of a member have the posterior N(mean, root root^T); the whole is an equal mixture of the members.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from surrogym_server.models.bayesian_last_layer.features import Features
from surrogym_server.models.ensemble.stepping import between


@dataclass(frozen=True)
class Regression:
    """Outputs centre + scale * phi(x)^T w. An output that never varied has scale 0."""

    features: Features  # of K p
    mean: Tensor  # of the weights (K, p, k)
    root: Tensor  # of their covariance (K, p, k, k)
    noise: Tensor  # variance of a single step, in squared scales (K, p)
    parts: Tensor  # prior variance of polynomial, units and waves (K, p, 3)
    centre: Tensor  # (p,)
    scale: Tensor  # (p,)
    left_out: Tensor  # leave-one-out error in scales, and shares within one and two deviations (p, 3)

    @property
    def members(self) -> int:
        return len(self.mean)

    @property
    def size(self) -> int:
        """Number of weights of all outputs, p k."""
        return self.mean[0].numel()

    @property
    def noise_deviation(self) -> Tensor:
        """Deviation of a single step (p,), in the output's unit."""
        return self.scale * self.noise.mean(0).sqrt()

    def phi(self, x: Tensor) -> Tensor:
        """Features at x (m, d), (K, p, m, k)."""
        quadratic = self.mean.shape[-1] > self.features.units + self.features.waves + 1 + x.shape[-1]
        phi = self.features(x, quadratic=quadratic)
        return phi.reshape(*self.noise.shape, *phi.shape[1:])

    def members_means(self, phi: Tensor) -> Tensor:
        """Mean of each member, (K, m, p)."""
        return self.centre + self.scale * (phi @ self.mean[..., None])[..., 0].mT

    def deviation(self, phi: Tensor) -> Tensor:
        """Deviation of the mixture (m, p): of the members' variances and of their means."""
        within = (phi @ self.root).square().sum(-1).mean(0)
        apart = between((phi @ self.mean[..., None])[..., 0], correction=0)
        return self.scale * (within + apart).mT.sqrt()

    def means(self, x: Tensor) -> Tensor:
        """Mean (m, p) at x (m, d)."""
        return self.members_means(self.phi(x)).mean(0)

    def drawn(self, noise: Tensor, member: Tensor) -> Tensor:
        """Weights (N, p k) of members (N,) by standard normal numbers (N, p k)."""
        standard = noise.reshape(-1, *self.mean.shape[1:])
        weights = self.mean[:, None] + torch.einsum("kpij,npj->knpi", self.root, standard)
        return _chosen(weights, member).flatten(1)

    def along(self, phi: Tensor, member: Tensor, weights: Tensor) -> Tensor:
        """Values (m, p) of the functions with these weights (m, p k), each row of its own member (m,)."""
        own = _chosen(phi.transpose(1, 2), member)
        return self.centre + self.scale * (own * weights.reshape(-1, *self.mean.shape[1:])).sum(-1)

    def factor(self, phi: Tensor) -> Tensor:
        """F (p, m, K (k + 1)) with F F^T the covariance of the mixture at m points, in squared scales."""
        values = (phi @ self.mean[..., None])[..., 0]
        parts = [*(phi @ self.root), *(values - values.mean(0))[..., None]]
        whole: Tensor = torch.cat(parts, -1) / self.members**0.5
        return whole

    def as_if_answered(self, column: int, phi: Tensor) -> Regression:
        """Condition an output of every member on observations of its own mean at points with features phi
        (K, p, t, k): with A = I + R^T phi^T phi R / s^2 = L L^T the new root is R L^-T."""
        seen = phi[:, column] @ self.root[:, column]
        a = seen.mT @ seen / self.noise[:, column, None, None] + torch.eye(seen.shape[-1]).to(seen)
        root = self.root.clone()
        root[:, column] = torch.linalg.solve_triangular(
            torch.linalg.cholesky(a), self.root[:, column].mT, upper=False
        ).mT
        return replace(self, root=root)


def _chosen(values: Tensor, member: Tensor) -> Tensor:
    """The value of one member (m,) in each row of values (K, m, ...)."""
    return values[member, torch.arange(len(member), device=member.device)]
