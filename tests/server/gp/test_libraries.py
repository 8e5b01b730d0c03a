"""The posterior is that of two independent libraries, to 1e-6 in units of the prior's deviation.

The quadratic part is not in either library: it is a linear kernel on squared inputs, which GPyTorch can be told.
"""

import warnings

import numpy as np
import pytest
import torch
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, DotProduct

from surrogym_server.gp import Hyperparameters, Posterior, condition
from surrogym_server.gp.kernel import covariance, variance

with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)  # of torch.jit, at import
    import gpytorch
    from gpytorch.kernels import LinearKernel, RBFKernel, ScaleKernel

POINTS, TESTS, INPUTS = 40, 200, 3


def points(rng: np.random.Generator) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    x = torch.from_numpy(rng.normal(size=(POINTS, INPUTS)))
    y = torch.sin(2 * x[:, 0]) + 0.5 * x[:, 1] + 0.01 * torch.from_numpy(rng.normal(size=POINTS))
    return x, y, torch.from_numpy(rng.normal(size=(TESTS, INPUTS)) * 1.5)


def assert_agree(posterior: Posterior, at: torch.Tensor, mean: np.ndarray, std: np.ndarray) -> None:
    ours, latent = posterior.mean_and_variance(at)
    prior = variance(posterior.hyper, at).numpy()
    np.testing.assert_allclose((ours.numpy() - mean) / np.sqrt(prior), 0, atol=1e-6)
    np.testing.assert_allclose((latent.numpy() - std**2) / prior, 0, atol=1e-6)
    np.testing.assert_allclose(posterior.mean(at).numpy(), ours.numpy(), atol=1e-12)


@pytest.mark.parametrize("noise", [1e-4, 1e-2, 0.5])
@pytest.mark.parametrize("linear", [0.0, 0.7])
def test_the_posterior_equals_that_of_scikit_learn(rng, linear, noise):
    x, y, at = points(rng)
    hyper = Hyperparameters(torch.tensor([0.8, 1.7, 3.1], dtype=torch.float64), 1.6, linear, 0.0, noise)
    kernel = ConstantKernel(1.6) * RBF(hyper.lengthscale.numpy())
    if linear:
        kernel += ConstantKernel(linear) * DotProduct(sigma_0=1.0)
    reference = GaussianProcessRegressor(kernel, alpha=noise, optimizer=None).fit(x.numpy(), y.numpy())
    assert_agree(condition(hyper, x, y), at, *reference.predict(at.numpy(), return_std=True))


class Reference(gpytorch.models.ExactGP):
    """The process of ``hyper`` over [x, x^2, 1]."""

    def __init__(self, x: torch.Tensor, y: torch.Tensor, hyper: Hyperparameters) -> None:
        likelihood = gpytorch.likelihoods.GaussianLikelihood()
        likelihood.noise = hyper.noise_variance
        super().__init__(self.expand(x), y, likelihood)
        d = x.shape[1]
        self.mean_module = gpytorch.means.ZeroMean()
        smooth = ScaleKernel(RBFKernel(ard_num_dims=d, active_dims=tuple(range(d))))
        smooth.outputscale, smooth.base_kernel.lengthscale = hyper.signal_variance, hyper.lengthscale
        self.covar_module = smooth
        parts = (
            (hyper.linear_variance, (*range(d), 2 * d)),
            (hyper.quadratic_variance, tuple(range(d, 2 * d))),
        )
        for amount, dims in parts:
            if amount:
                part = LinearKernel(active_dims=dims)
                part.variance = amount
                self.covar_module = self.covar_module + part
        self.double()
        self.eval()

    @staticmethod
    def expand(x: torch.Tensor) -> torch.Tensor:
        return torch.cat([x, x.square(), torch.ones(len(x), 1, dtype=x.dtype)], 1)

    def forward(self, x: torch.Tensor) -> gpytorch.distributions.MultivariateNormal:
        return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))


def test_the_posterior_equals_that_of_gpytorch(rng, plain):
    x, y, at = points(rng)
    torch.set_default_dtype(torch.float64)
    try:
        with torch.no_grad(), gpytorch.settings.fast_computations(False, False, False):
            reference = Reference(x, y, plain)(Reference.expand(at))
            mean, std = reference.mean.numpy(), reference.variance.sqrt().numpy()
    finally:
        torch.set_default_dtype(torch.float32)
    assert_agree(condition(plain, x, y), at, mean, std)


def test_the_prior_variance_equals_the_diagonal_of_the_covariance(rng, hyper):
    x, _, _ = points(rng)
    torch.testing.assert_close(variance(hyper, x), covariance(hyper, x, x).diagonal(), rtol=1e-12, atol=0)


def test_the_covariance_is_accurate_far_from_the_origin(rng):
    x = torch.from_numpy(np.round(rng.normal(size=(10, 2)) * 2**20) / 2**20)  # so that shifting by 1024 is exact
    hyper = Hyperparameters(torch.tensor([0.02, 0.5], dtype=torch.float64), 1.0, 0.0, 0.0, 1e-8)
    far, here = covariance(hyper, x + 1024, x + 1024), covariance(hyper, x, x)
    torch.testing.assert_close(far, here, rtol=1e-12, atol=1e-15)
