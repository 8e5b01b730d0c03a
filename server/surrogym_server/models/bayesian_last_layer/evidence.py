"""Exact Bayesian linear regression on features: its log evidence, and the posterior of its weights.

For one output with targets y (n,) and features Phi (n, k),

    y = Phi w + e,  w ~ N(0, V),  e ~ N(0, s^2 I),  V = diag(v),

    log p(y) = -1/2 (y^T K^-1 y + log det K + n log 2 pi),  K = Phi V Phi^T + s^2 I.

With n < k the evidence is computed from K (the dual form). Otherwise from A = I + V^1/2 G V^1/2 / s^2 with
G = Phi^T Phi (the primal form), where

    log det K = n log s^2 + log det A,  y^T K^-1 y = (|y - Phi m|^2 / s^2 + m^T V^-1 m),

and m is the posterior mean. m minimises the second expression, so its own gradient vanishes, and an error in m counts
only squared. The posterior is always of the k weights, N(m, R R^T) with R = V^1/2 L^-T and A = L L^T.

Shapes: p outputs, n samples, k features. All matrices are batches of p.

Reference: C. Bishop, "Pattern Recognition and Machine Learning" (2006), sections 3.3 and 3.5.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Moments:
    """All that a regression in primal form needs of its samples."""

    gram: Tensor  # Phi^T Phi (p, k, k)
    product: Tensor  # Phi^T y (p, k)
    square: Tensor  # y^T y (p,)
    count: int  # n

    @classmethod
    def of(cls, phi: Tensor, y: Tensor) -> Moments:
        """Moments of features phi (p, n, k) and targets y (p, n)."""
        return cls(phi.mT @ phi, (phi.mT @ y[..., None])[..., 0], y.square().sum(-1), y.shape[-1])

    def __add__(self, other: Moments) -> Moments:
        return Moments(
            self.gram + other.gram,
            self.product + other.product,
            self.square + other.square,
            self.count + other.count,
        )


@dataclass(frozen=True)
class Weights:
    """Posterior N(mean, root root^T) of the last layer's weights."""

    mean: Tensor  # m (p, k)
    root: Tensor  # R (p, k, k)


def log_evidence(phi: Tensor, y: Tensor, prior: Tensor, noise: Tensor) -> Tensor:
    """Log marginal likelihood (p,) of targets y (p, n), given features phi (p, n, k), variances ``prior`` (p, k) of the
    weights and variances ``noise`` (p,). It is differentiable in all of them except y."""
    if phi.shape[-2] < phi.shape[-1]:
        return _dual(phi, y, prior, noise)
    return log_evidence_of(Moments.of(phi, y), prior, noise)


def log_evidence_of(moments: Moments, prior: Tensor, noise: Tensor) -> Tensor:
    """The same (p,) from moments, in primal form. It is exact for n < k too, but slower."""
    factor = _factor(moments, prior, noise)
    with torch.no_grad():
        mean = _mean(moments, prior, noise, factor)
    off = (
        moments.square
        - 2 * (moments.product * mean).sum(-1)
        + (mean * (moments.gram @ mean[..., None])[..., 0]).sum(-1)
    )
    fit = off.clamp_min(0) / noise + (mean.square() / prior).sum(-1)
    roots = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    return -0.5 * (fit + moments.count * (noise.log() + math.log(2 * math.pi))) - roots


def posterior(moments: Moments, prior: Tensor, noise: Tensor) -> Weights:
    """Posterior of the weights, given variances ``prior`` (p, k) of the weights and ``noise`` (p,)."""
    factor = _factor(moments, prior, noise)
    inverse = torch.linalg.solve_triangular(factor, torch.eye(prior.shape[-1], dtype=prior.dtype), upper=False)
    return Weights(_mean(moments, prior, noise, factor), prior.sqrt()[..., None] * inverse.mT)


def left_out(phi: Tensor, y: Tensor, mean: Tensor, root: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Error and predictive variance (noise included) of each target y (p, n) from all others, (p, n) each, given the
    posterior of all: ``mean`` (p, k), ``root`` (p, k, k) and ``noise`` (p,).

    With the leverage h_i = phi_i^T S phi_i / s^2 these are (y_i - phi_i^T m) / (1 - h_i) and s^2 / (1 - h_i). The
    features and the variances stay those of all samples. More leading dimensions are batches.

    Reference: C. Rasmussen, C. Williams (2006), eq. 5.12, in terms of weights.
    """
    leverage = (phi @ root).square().sum(-1) / noise[..., None]
    free = (1 - leverage).clamp_min(torch.finfo(phi.dtype).eps)
    error = y - (phi @ mean[..., None])[..., 0]
    return error / free, noise[..., None] / free


def _dual(phi: Tensor, y: Tensor, prior: Tensor, noise: Tensor) -> Tensor:
    n = phi.shape[-2]
    covariance = (phi * prior[:, None, :]) @ phi.mT + noise[:, None, None] * torch.eye(n, dtype=phi.dtype)
    factor: Tensor = torch.linalg.cholesky(covariance)
    white = torch.linalg.solve_triangular(factor, y[..., None], upper=False)[..., 0]
    roots = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    evidence: Tensor = -0.5 * (white.square().sum(-1) + n * math.log(2 * math.pi)) - roots
    return evidence


def _factor(moments: Moments, prior: Tensor, noise: Tensor) -> Tensor:
    """L (p, k, k) with L L^T = A."""
    scale = prior.sqrt()
    one = torch.eye(prior.shape[-1], dtype=prior.dtype)
    a = one + scale[..., :, None] * moments.gram * scale[..., None, :] / noise[:, None, None]
    factor: Tensor = torch.linalg.cholesky(a)
    return factor


def _mean(moments: Moments, prior: Tensor, noise: Tensor, factor: Tensor) -> Tensor:
    """m (p, k) = V^1/2 A^-1 V^1/2 Phi^T y / s^2."""
    scale = prior.sqrt()
    solved = torch.cholesky_solve((scale * moments.product / noise[:, None])[..., None], factor)
    return scale * solved[..., 0]
