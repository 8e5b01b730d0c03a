"""The regression of the last layer is exact: evidence, posterior and leave-one-out errors are those of a dense normal
distribution."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from surrogym_server.models.bayesian_last_layer.evidence import (
    Moments,
    left_out,
    log_evidence,
    log_evidence_of,
    posterior,
)

Problem = tuple[Tensor, Tensor, Tensor, Tensor]
FEW, MANY = 7, 40  # samples: fewer and more than the 12 features


def problem(count: int) -> Problem:
    """Features (2, n, 12), targets (2, n), prior variances (2, 12) and noise variances (2,)."""
    generator = torch.Generator().manual_seed(3)
    phi = torch.randn(2, count, 12, generator=generator, dtype=torch.float64)
    y = torch.randn(2, count, generator=generator, dtype=torch.float64)
    prior = torch.rand(2, 12, generator=generator, dtype=torch.float64) + 0.1
    return phi, y, prior, torch.tensor([0.3, 1e-6], dtype=torch.float64)


def dense_log_density(phi: np.ndarray, y: np.ndarray, prior: np.ndarray, noise: float) -> float:
    covariance = phi @ np.diag(prior) @ phi.T + noise * np.eye(len(y))
    sign, log_determinant = np.linalg.slogdet(covariance)
    assert sign == 1
    return float(-0.5 * (y @ np.linalg.solve(covariance, y) + log_determinant + len(y) * np.log(2 * np.pi)))


@pytest.mark.parametrize("count", [FEW, MANY])
def test_evidence_is_the_density_of_a_dense_normal_distribution(count):
    phi, y, prior, noise = problem(count)
    for found in (log_evidence(phi, y, prior, noise), log_evidence_of(Moments.of(phi, y), prior, noise)):
        for output in range(2):
            dense = dense_log_density(*(part[output].numpy() for part in (phi, y, prior)), float(noise[output]))
            assert float(found[output]) == pytest.approx(dense, rel=1e-6)


@pytest.mark.parametrize("count", [FEW, MANY])
def test_gradients_of_the_evidence_are_those_of_differences(count):
    phi, y, prior, noise = problem(count)
    noise = noise + 0.1
    inputs = tuple(tensor.requires_grad_() for tensor in (phi[:, :, :3].clone(), prior, noise))

    def evidence(some: Tensor, prior: Tensor, noise: Tensor) -> Tensor:
        return log_evidence(torch.cat([some, phi[:, :, 3:]], -1), y, prior, noise)

    assert torch.autograd.gradcheck(evidence, inputs, eps=1e-6, atol=1e-4)


@pytest.mark.parametrize("count", [FEW, MANY])
def test_posterior_is_that_of_normal_equations(count):
    phi, y, prior, noise = problem(count)
    found = posterior(Moments.of(phi, y), prior, noise)
    precision = phi[0].T @ phi[0] / noise[0] + prior[0].reciprocal().diag()
    covariance = torch.linalg.inv(precision)
    torch.testing.assert_close(found.root[0] @ found.root[0].T, covariance)
    torch.testing.assert_close(found.mean[0], covariance @ phi[0].T @ y[0] / noise[0])


def test_left_out_errors_are_those_of_refits_without_the_sample():
    phi, y, prior, noise = problem(MANY)
    whole = posterior(Moments.of(phi, y), prior, noise)
    error, variance = left_out(phi, y, whole.mean, whole.root, noise)
    for sample in (0, 5):
        rest = [i for i in range(MANY) if i != sample]
        refit = posterior(Moments.of(phi[:, rest], y[:, rest]), prior, noise)
        alone = y[:, sample] - (phi[:, sample] * refit.mean).sum(-1)
        latent = (phi[:, sample, None] @ refit.root).square().sum((-1, -2))
        torch.testing.assert_close(error[0, sample], alone[0])
        torch.testing.assert_close(variance[0, sample], latent[0] + noise[0])


def test_moments_of_blocks_add_up():
    phi, y, *_ = problem(MANY)
    whole, parts = Moments.of(phi, y), Moments.of(phi[:, :9], y[:, :9]) + Moments.of(phi[:, 9:], y[:, 9:])
    torch.testing.assert_close(vars(whole), vars(parts))
