"""Posterior samples of a process by Matheron's rule: functions, each with one consistent value at every input.

A posterior sample is the posterior's mean plus a residual, g(x) - k(x, X) (K + sigma_n^2 I)^-1 (g(X) + e), where g is a
sample of the prior and e one of the noise. The residual is g conditioned to vanish at the data. g is exact in the
polynomial parts, which have finitely many features. For the squared exponential it uses random Fourier features, cosine
and sine of the same frequency, so that its prior variance is exact. The update is exact, through the Cholesky factor.

All posterior samples share fixed frequencies and differ in their weights: the values of N of them, at one input each,
cost one matrix product and N scalar products. Under a reflection the features are those of (f(x) + p f(s x)) / sqrt(2).
With S frequencies the prior's covariance has an error of about sigma_f^2 / sqrt(2 S).

References: Wilson et al., "Efficiently sampling functions from Gaussian process posteriors", ICML 2020, eq. 13; Rahimi
and Recht, "Random features for large-scale kernel machines", NeurIPS 2007.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
import torch
from torch import Tensor

from surrogym_server.gp.kernel import covariance
from surrogym_server.gp.posterior import Posterior
from surrogym_server.tensors import cached

FREQUENCIES = 256  # number S of frequencies; each gives two random Fourier features, a cosine and a sine


@dataclass(frozen=True)
class Pathwise:
    """Sampler of functions from the posterior of one process. A sampled function is a row of ``size`` weights: first
    the weights of the prior's features, then those of the n points."""

    posterior: Posterior

    @property
    def size(self) -> int:
        """Number of weights of a posterior sample, and of the standard normal numbers from which it is computed."""
        return self._features + len(self.posterior.y)

    def draw(self, noise: Tensor) -> Tensor:
        """Return the weights (N, size) of N posterior samples, computed from standard normal ``noise`` (N, size)."""
        posterior = self.posterior
        prior, at_samples = noise[:, : self._features], noise[:, self._features :]
        at_points = prior @ self._prior_at_points.T + self._noise(at_samples)
        return torch.cat([prior, -torch.cholesky_solve(at_points.T, posterior.factor).T], 1)

    def residual(self, x: Tensor, weights: Tensor, k: Tensor | None = None) -> Tensor:
        """Return the residuals (N,) at N inputs x (N, d): by how much the posterior sample in the same row of
        ``weights`` (N, size) exceeds the posterior mean. The prior covariances of x with the n points over sigma_f^2
        may be given, k (N, n)."""
        hyper = self.posterior.hyper
        if k is None:
            k = covariance(hyper, x, self.posterior.x) / hyper.signal_variance
        residual, begin = torch.zeros_like(x[:, 0]), 0
        for part in [*self._parts(x), hyper.signal_variance * k]:
            residual.add_((part * weights[:, begin : (begin := begin + part.shape[1])]).sum(1))
        return residual

    @cached_property
    def size_of_update(self) -> float:
        """Sum over the n points of the standard deviation of their weights in a posterior sample, in the data: the
        weights have the covariance (K + sigma_n^2 I)^-1."""
        variances: Tensor = torch.cholesky_inverse(self.posterior.factor).diagonal()
        return float(variances.clamp_min(0).sqrt().sum())

    def _noise(self, at_samples: Tensor) -> Tensor:
        """Return N samples of the noise at the n points, (N, n), computed from standard normal numbers ``at_samples``
        (N, n)."""
        posterior = self.posterior
        if posterior.sparse is not None:
            return at_samples @ self._sparse_noise
        return math.sqrt(posterior.hyper.noise_variance + posterior.jitter) * at_samples

    @cached
    def _sparse_noise(self) -> Tensor:
        """Symmetric square root (n, n) of the covariance of the noise at the n inducing points Z, which is F F^T - k(Z,
        Z), with F the factor of the posterior."""
        posterior = self.posterior
        left = posterior.factor @ posterior.factor.T - covariance(posterior.hyper, posterior.x, posterior.x)
        values, vectors = torch.linalg.eigh(left)
        root: Tensor = (vectors * values.clamp_min(0).sqrt()) @ vectors.T
        return root

    @cached_property
    def _features(self) -> int:
        return self._prior(self.posterior.x[:1]).shape[1]

    @cached
    def _prior_at_points(self) -> Tensor:
        """Features of the prior at the n points, (n, features)."""
        return self._prior(self.posterior.x)

    def _prior(self, x: Tensor) -> Tensor:
        """Return features of the prior at x (m, d): 2 S random Fourier features, then those of the polynomial parts.
        The scalar product of the features at two inputs approximates their prior covariance."""
        return torch.cat(self._parts(x), 1)

    def _parts(self, x: Tensor) -> list[Tensor]:
        """Return the features of the prior at x (m, d) in parts, in the order of ``_prior``: cosines and sines, with a
        reflection those of functions that have it, then the polynomial parts."""
        hyper, phase = self.posterior.hyper, x @ self._frequencies
        variance = hyper.signal_variance / FREQUENCIES
        if (reflection := hyper.reflection) is None:
            parts = [phase.cos(), phase.sin()]
        else:
            phase, image = phase.chunk(2, 1)
            parts = [torch.add(f(phase), f(image), alpha=reflection.parity) for f in (torch.cos, torch.sin)]
            variance /= 2
        parts = [waves.mul_(math.sqrt(variance)) for waves in parts]
        polynomial, powers = hyper.polynomial, []
        if hyper.linear_variance > 0:
            powers += [x.new_full((len(x), 1), math.sqrt(polynomial.constant)), polynomial.linear.sqrt() * x]
        if hyper.quadratic_variance > 0:
            powers.append(polynomial.quadratic.sqrt() * x.square())
        return [*parts, torch.cat(powers, 1)] if powers else parts

    @cached
    def _frequencies(self) -> Tensor:
        """Frequencies of the features in units of the inputs, (d, S), or with a reflection these and then those at the
        mirror image, (d, 2 S)."""
        hyper = self.posterior.hyper
        scaled = frequencies(len(hyper.lengthscale), hyper.lengthscale.device) / hyper.lengthscale[:, None]
        if hyper.reflection is None:
            return scaled
        return torch.cat([scaled, hyper.reflection.signs[:, None] * scaled], 1)


@cache
@torch.inference_mode(False)
def frequencies(d: int, device: torch.device) -> Tensor:
    """Return the S frequencies (d, S) of the random Fourier features of the squared exponential for d inputs, in units
    of 1 / length scale. They are standard normal numbers from a fixed seed."""
    values = np.random.Generator(np.random.Philox(key=d)).standard_normal((d, FREQUENCIES))
    return torch.from_numpy(values).to(device)
