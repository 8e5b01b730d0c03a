"""Functions drawn by Matheron's rule have the posterior's mean and covariance, and pass through the data."""

import math

import numpy as np
import pytest
import torch

from surrogym_server.gp import Pathwise, Posterior, condition
from surrogym_server.gp.kernel import covariance
from surrogym_server.gp.pathwise import FREQUENCIES


@pytest.fixture
def posterior(hyper, rng: np.random.Generator) -> Posterior:
    x = torch.from_numpy(rng.normal(size=(14, 3)))
    return condition(hyper, x, torch.sin(x[:, 0]) + 0.3 * x[:, 2])


@pytest.fixture
def at(rng: np.random.Generator) -> torch.Tensor:
    return torch.from_numpy(rng.normal(size=(9, 3)))


def responses(posterior: Posterior, at: torch.Tensor) -> torch.Tensor:
    """What each number of a draw's noise adds to it at points (m, d): (m, size). A draw is linear in its noise."""
    paths = Pathwise(posterior)
    weights = paths.draw(torch.eye(paths.size, dtype=torch.float64))
    return torch.stack([paths.residual(point.expand(paths.size, -1), weights) for point in at])


def exact_covariance(posterior: Posterior, at: torch.Tensor) -> torch.Tensor:
    k = covariance(posterior.hyper, posterior.x, at)
    return covariance(posterior.hyper, at, at) - k.T @ torch.cholesky_solve(k, posterior.factor)


def test_pathwise_draws_have_the_posterior_covariance_analytically(posterior, at):
    """Exactly, but for the mean over frequencies: it is off by 5 of its standard errors at most."""
    response = responses(posterior, at)
    cosines, sines = response[:, :FREQUENCIES], response[:, FREQUENCIES : 2 * FREQUENCIES]
    of_frequency = FREQUENCIES * (cosines[:, None] * cosines + sines[:, None] * sines)
    error = of_frequency.std(-1) / math.sqrt(FREQUENCIES)
    off = (response @ response.T - exact_covariance(posterior, at)).abs()
    assert (off <= 5 * error + 1e-9).all()


def test_many_pathwise_draws_have_the_posterior_mean_and_covariance(posterior, at, rng):
    """To 5 standard errors of 4,000 draws."""
    paths, count = Pathwise(posterior), 4_000
    weights = paths.draw(torch.from_numpy(rng.standard_normal((count, paths.size))))
    residuals = torch.stack([paths.residual(point.expand(count, -1), weights) for point in at])
    expected = responses(posterior, at)
    expected = expected @ expected.T
    variance = expected.diagonal()
    assert (residuals.mean(1).abs() <= 5 * (variance / count).sqrt()).all()
    error = ((torch.outer(variance, variance) + expected.square()) / count).sqrt()
    assert ((residuals.cov() - expected).abs() <= 5 * error).all()


def test_pathwise_draws_pass_through_the_data_up_to_noise(posterior, rng):
    paths = Pathwise(posterior)
    weights = paths.draw(torch.from_numpy(rng.standard_normal((200, paths.size))))
    noise = math.sqrt(posterior.hyper.noise_variance)
    for x in posterior.x:
        assert float(paths.residual(x.expand(200, -1), weights).std()) < 1.5 * noise


def test_a_pathwise_draw_with_zero_random_weights_equals_the_mean(posterior, at):
    paths = Pathwise(posterior)
    weights = paths.draw(torch.zeros(len(at), paths.size, dtype=torch.float64))
    assert paths.residual(at, weights).abs().max() == 0


def test_a_pathwise_draw_has_the_same_values_in_any_batch(posterior, at, rng):
    paths = Pathwise(posterior)
    weights = paths.draw(torch.from_numpy(rng.standard_normal((len(at), paths.size))))
    together = paths.residual(at, weights)
    alone = torch.cat([paths.residual(at[i : i + 1], weights[i : i + 1]) for i in range(len(at))])
    torch.testing.assert_close(together, alone, rtol=1e-9, atol=1e-9)
