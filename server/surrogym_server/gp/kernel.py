"""Covariance: squared exponential with automatic relevance determination (eq. 5), plus optional polynomial parts.

k(x, x') = sigma_f^2 exp(-1/2 (x - x')^T Lambda (x - x')) + sigma_l^2 (1 + x^T x') + sigma_q^2 sum_j x_j^2 x'_j^2,
and the noise is never inside it. The last part has no cross terms: it is a quadratic cost with diagonal weights.

With a reflection s the process has only functions with f(s x) = p f(x), s x elementwise. Its squared exponential is
sigma_f^2 (e(x, x') + p e(x, s x')), the covariance of (f(x) + p f(s x)) / sqrt(2). Its polynomial parts keep only the
terms of parity p: for an odd function the x_j whose sign s changes; for an even one the constant, the other x_j and
the squares.
Reference: Ginsbourger, Roustant, Durrande, "On degeneracy and invariances of random fields paths with applications in
Gaussian process modelling", Journal of Statistical Planning and Inference (2016), section 3.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Reflection:
    """A symmetry of functions: f(signs x) = parity f(x)."""

    signs: Tensor  # (d,) 1 or -1: the factor of each input in the mirror image
    parity: int  # 1: even, -1: odd

    @property
    def kept(self) -> Tensor:
        """1 for each input x_j for which f(x) = x_j has this symmetry, 0 for the others; shape (d,)."""
        return (1 + self.parity * self.signs) / 2


@dataclass(frozen=True)
class Polynomial:
    """The coefficients of constant + sum_j linear_j x_j x'_j + sum_j quadratic_j x_j^2 x'_j^2."""

    constant: float
    linear: Tensor  # (d,) coefficient of each x_j x'_j
    quadratic: Tensor  # (d,) coefficient of each x_j^2 x'_j^2
    has_squares: bool

    @classmethod
    def of(cls, linear: float, quadratic: float, reflection: Reflection | None, like: Tensor) -> Polynomial:
        """Build the polynomial with the terms of the reflection's parity, or with all terms without a reflection.

        Args:
            linear: variance of the constant and of each linear term.
            quadratic: variance of each square.
            reflection: the symmetry of the process, or None.
            like: any tensor (..., d), which gives the number of inputs, the dtype and the device.
        """
        ones = like.new_ones(like.shape[-1])
        if reflection is None:
            return cls(linear, linear * ones, quadratic * ones, quadratic > 0)
        even = reflection.parity > 0
        return cls(linear * even, linear * reflection.kept, quadratic * even * ones, even and quadratic > 0)

    def __call__(self, a: Tensor, b: Tensor) -> Tensor:
        """Return the covariances of inputs a (..., m, d) and b (..., n, d), shape (..., m, n)."""
        k = self.constant + (a * self.linear) @ b.mT
        return k + (a.square() * self.quadratic) @ b.square().mT if self.has_squares else k

    def diagonal(self, x: Tensor) -> Tensor:
        """Return the covariance of each input x (..., d) with itself, shape (...)."""
        squared = x.square()
        k = self.constant + squared @ self.linear
        return k + squared.square() @ self.quadratic if self.has_squares else k


@dataclass(frozen=True)
class Hyperparameters:
    """Hyperparameters of a process, chosen by the marginal likelihood, in units of standardised inputs and outputs."""

    lengthscale: Tensor  # (d,) one for each input
    signal_variance: float
    linear_variance: float  # 0 means no linear part
    quadratic_variance: float  # 0 means no quadratic part
    noise_variance: float
    reflection: Reflection | None = None

    @property
    def kernel(self) -> str:
        """Names of the parts of the covariance, such as `squared exponential + linear`."""
        parts = ["squared exponential"]
        parts += ["linear"] if self.linear_variance > 0 else []
        parts += ["quadratic"] if self.quadratic_variance > 0 else []
        return " + ".join(parts)

    @property
    def has_polynomial(self) -> bool:
        return self.linear_variance > 0 or self.quadratic_variance > 0

    @property
    def polynomial(self) -> Polynomial:
        """Polynomial part of the covariance: all of it but the squared exponential."""
        return Polynomial.of(self.linear_variance, self.quadratic_variance, self.reflection, self.lengthscale)


def covariance(hyper: Hyperparameters, a: Tensor, b: Tensor) -> Tensor:
    """Latent covariance of inputs a (..., m, d) and b (..., n, d), shape (..., m, n).

    Distances are taken by differences: the expansion |a|^2 + |b|^2 - 2 a.b loses the digits that a small noise needs.
    """
    k = hyper.signal_variance * _smooth(hyper, a, b)
    if (reflection := hyper.reflection) is not None:
        k = k + hyper.signal_variance * reflection.parity * _smooth(hyper, a, b * reflection.signs)
    return k + hyper.polynomial(a, b) if hyper.has_polynomial else k


def variance(hyper: Hyperparameters, x: Tensor) -> Tensor:
    """Latent prior variance k(x, x) of inputs x (m, d), shape (m,)."""
    prior = torch.full(x.shape[:-1], hyper.signal_variance, dtype=x.dtype, device=x.device)
    if (reflection := hyper.reflection) is not None:
        prior = prior + hyper.signal_variance * reflection.parity * (x.square() @ to_mirror(hyper)).exp()
    return prior + hyper.polynomial.diagonal(x) if hyper.has_polynomial else prior


def to_mirror(hyper: Hyperparameters) -> Tensor:
    """Coefficients c (d,) with e(x, s x) = exp(sum_j c_j x_j^2): x and s x differ by 2 x_j where s_j is -1."""
    assert hyper.reflection is not None
    return (hyper.reflection.signs - 1) / hyper.lengthscale.square()


def _smooth(hyper: Hyperparameters, a: Tensor, b: Tensor) -> Tensor:
    distance = torch.cdist(a / hyper.lengthscale, b / hyper.lengthscale, compute_mode="donot_use_mm_for_euclid_dist")
    return torch.exp(-0.5 * distance.square())
