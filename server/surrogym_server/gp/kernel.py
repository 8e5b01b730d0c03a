"""Covariance: squared exponential with automatic relevance determination (eq. 5), plus optional polynomial parts.

k(x, x') = sigma_f^2 exp(-1/2 (x - x')^T Lambda (x - x')) + sigma_l^2 (1 + x^T x') + sigma_q^2 sum_j x_j^2 x'_j^2,
and the noise is never inside it. The last part has no cross terms: it is a quadratic cost with diagonal weights.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Hyperparameters:
    """What the marginal likelihood chooses. Units: inputs and outputs are standardised."""

    lengthscale: Tensor  # (d,)
    signal_variance: float
    linear_variance: float  # 0: no linear part
    quadratic_variance: float  # 0: no quadratic part
    noise_variance: float

    @property
    def kernel(self) -> str:
        """The parts of the covariance, in words."""
        parts = ["squared exponential"]
        parts += ["linear"] if self.linear_variance > 0 else []
        parts += ["quadratic"] if self.quadratic_variance > 0 else []
        return " + ".join(parts)


def covariance(hyper: Hyperparameters, a: Tensor, b: Tensor) -> Tensor:
    """Latent covariance of inputs a (..., m, d) and b (..., n, d), shape (..., m, n).

    Distances are taken by differences: the expansion |a|^2 + |b|^2 - 2 a.b loses the digits that a small noise needs.
    """
    distance = torch.cdist(a / hyper.lengthscale, b / hyper.lengthscale, compute_mode="donot_use_mm_for_euclid_dist")
    k = hyper.signal_variance * torch.exp(-0.5 * distance.square())
    if hyper.linear_variance > 0:
        k = k + hyper.linear_variance * (1 + a @ b.mT)
    if hyper.quadratic_variance > 0:
        k = k + hyper.quadratic_variance * (a.square() @ b.square().mT)
    return k


def variance(hyper: Hyperparameters, x: Tensor) -> Tensor:
    """Latent prior variance k(x, x) of inputs x (m, d), shape (m,)."""
    prior = torch.full(x.shape[:-1], hyper.signal_variance, dtype=x.dtype, device=x.device)
    if hyper.linear_variance > 0:
        prior = prior + hyper.linear_variance * (1 + x.square().sum(-1))
    if hyper.quadratic_variance > 0:
        prior = prior + hyper.quadratic_variance * x.square().square().sum(-1)
    return prior
