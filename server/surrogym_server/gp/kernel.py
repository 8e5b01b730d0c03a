"""Covariance: squared exponential with automatic relevance determination (eq. 5), plus optional polynomial parts.

k(x, x') = sigma_f^2 exp(-1/2 (x - x')^T Lambda (x - x')) + sigma_l^2 (1 + x^T x') + sigma_q^2 sum_j x_j^2 x'_j^2,
and the noise is never part of it. The last part has no cross terms: it suits a quadratic cost with diagonal weights.

With a reflection s the process has only functions with f(s x) = p f(x), s x elementwise. Its squared exponential is
sigma_f^2 (e(x, x') + p e(x, s x')), the covariance of (f(x) + p f(s x)) / sqrt(2). Its polynomial parts keep only the
terms of parity p: for an odd function the x_j whose sign s changes; for an even one the constant, the other x_j and
the squares.

Other files that assume the squared exponential, and change with it: ``gp.search`` and ``gp.variational_bound``
(gradients of the evidence), ``gp.pathwise`` (Fourier features), ``gp.serving`` and ``gp.compiled`` (fast predictions),
and ``step.c`` of ``models.gaussian_process.prediction.compiled``. All others call ``covariance`` and ``variance``.

Reference: Ginsbourger, Roustant, Durrande, "On degeneracy and invariances of random fields paths with applications in
Gaussian process modelling", Journal of Statistical Planning and Inference (2016), section 3.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from surrogym_server.tensors import cached


@dataclass(frozen=True)
class Reflection:
    """Mirror symmetry of functions: f(signs x) = parity f(x)."""

    signs: Tensor  # (d,) 1 or -1: the factor of each input in the mirror image
    parity: int  # 1 for even functions, -1 for odd functions

    @property
    def kept(self) -> Tensor:
        """Which linear terms have this symmetry, (d,): 1 for each input x_j for which the function f(x) = x_j has it, 0
        for the others."""
        return (1 + self.parity * self.signs) / 2


@dataclass(frozen=True)
class Polynomial:
    """Coefficients of the covariance constant + sum_j linear_j x_j x'_j + sum_j quadratic_j x_j^2 x'_j^2 of inputs x
    and x'."""

    constant: float
    linear: Tensor  # (d,) coefficient of each x_j x'_j
    quadratic: Tensor  # (d,) coefficient of each x_j^2 x'_j^2
    has_squares: bool

    @classmethod
    def of(cls, linear: float, quadratic: float, reflection: Reflection | None, like: Tensor) -> Polynomial:
        """Build the polynomial. With a reflection, it only has the terms that have this symmetry.

        Args:
            linear: variance of the constant and of each linear term.
            quadratic: variance of each quadratic term.
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

    lengthscale: Tensor  # (d,) length scale of each input
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

    @cached
    def polynomial(self) -> Polynomial:
        """Polynomial part of the covariance, that is everything except the squared exponential."""
        return Polynomial.of(self.linear_variance, self.quadratic_variance, self.reflection, self.lengthscale)


def covariance(hyper: Hyperparameters, a: Tensor, b: Tensor) -> Tensor:
    """Return the prior covariances (..., m, n), without noise, of the function at inputs a (..., m, d) with those at b
    (..., n, d).

    Squared distances are computed from differences. The expansion |a|^2 + |b|^2 - 2 a.b has a rounding error that is
    too large if the noise is small.
    """
    k = hyper.signal_variance * _smooth(hyper, a, b)
    if (reflection := hyper.reflection) is not None:
        k = k + hyper.signal_variance * reflection.parity * _smooth(hyper, a, b * reflection.signs)
    return k + hyper.polynomial(a, b) if hyper.has_polynomial else k


def variance(hyper: Hyperparameters, x: Tensor) -> Tensor:
    """Return the prior variances k(x, x) (m,), without noise, of the function at inputs x (m, d)."""
    prior = torch.full(x.shape[:-1], hyper.signal_variance, dtype=x.dtype, device=x.device)
    if (reflection := hyper.reflection) is not None:
        prior = prior + hyper.signal_variance * reflection.parity * (x.square() @ to_mirror(hyper)).exp()
    return prior + hyper.polynomial.diagonal(x) if hyper.has_polynomial else prior


def to_mirror(hyper: Hyperparameters) -> Tensor:
    """Return coefficients c (d,) such that exp(sum_j c_j x_j^2) is the squared exponential between x and its mirror
    image s x. These two differ by 2 x_j in each input with s_j = -1."""
    assert hyper.reflection is not None
    return (hyper.reflection.signs - 1) / hyper.lengthscale.square()


def _smooth(hyper: Hyperparameters, a: Tensor, b: Tensor) -> Tensor:
    distance = torch.cdist(a / hyper.lengthscale, b / hyper.lengthscale, compute_mode="donot_use_mm_for_euclid_dist")
    return torch.exp(-0.5 * distance.square())
