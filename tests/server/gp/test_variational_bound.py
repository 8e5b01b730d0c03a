"""The bound is a lower bound of the evidence with the right gradient, and what maximises it predicts and is not too
sure."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from surrogym_server.gp import (
    FitOptions,
    Hyperparameters,
    Posterior,
    Reflection,
    condition,
    condition_sparse,
    fewer_inputs,
    fit,
    fit_bound,
    fit_some,
    fit_through_few,
    loses_nothing,
    spread,
)
from surrogym_server.gp.search import Evidence
from surrogym_server.gp.sparse import pivots
from surrogym_server.gp.variational_bound import Bound

with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)  # of torch.jit, at import
    import gpytorch
    from gpytorch.kernels import InducingPointKernel, LinearKernel, RBFKernel, ScaleKernel

FLAT = (0.0, 1e4)  # a prior that says nothing
WITHOUT_PRIORS = {f"{name}_prior": FLAT for name in ("lengthscale", "signal", "linear", "quadratic", "noise")}
NOISE = 0.05


def points(count: int, inputs: int, seed: int) -> tuple[Tensor, Tensor]:
    rng = np.random.default_rng(seed)
    x = torch.from_numpy(rng.uniform(-1.7, 1.7, (count, inputs)))
    return x, torch.sin(2 * x[:, 0]) + 0.5 * x[:, 1] + NOISE * torch.from_numpy(rng.normal(size=count))


kernels = given(
    linear=st.booleans(),
    quadratic=st.booleans(),
    seed=st.integers(0, 2**32 - 1),
    noise=st.floats(-6.0, 0.0),
    parity=st.sampled_from([0, 1, -1]),
)


def drawn(
    linear: bool, quadratic: bool, seed: int, noise: float, parity: int
) -> tuple[Tensor, Tensor, FitOptions, Reflection | None, np.ndarray]:
    """Points, a kernel and its free parameters."""
    reflection = Reflection(torch.tensor([-1.0, 1.0], dtype=torch.float64), parity) if parity else None
    options, (x, y) = FitOptions(linear=linear, quadratic=quadratic), points(20, 2, seed)
    theta = np.random.default_rng(seed).uniform(-1.0, 1.0, 4 + linear + quadratic)
    theta[-1] = noise
    return x, y, options, reflection, theta


@settings(max_examples=40)
@kernels
def test_the_gradient_of_the_sparse_bound_equals_finite_differences(linear, quadratic, seed, noise, parity):
    x, y, options, reflection, theta = drawn(linear, quadratic, seed, noise, parity)
    bound = Bound(x, y, torch.arange(0, 20, 3), options, reflection)
    _, gradient = bound(theta)
    step = 1e-5
    for i, direction in enumerate(np.eye(len(theta))):
        difference = (bound(theta + step * direction)[0] - bound(theta - step * direction)[0]) / (2 * step)
        assert gradient[i] == pytest.approx(difference, rel=1e-4, abs=1e-4)


@settings(max_examples=40)
@kernels
def test_the_sparse_bound_never_exceeds_the_log_marginal_likelihood(linear, quadratic, seed, noise, parity):
    x, y, options, reflection, theta = drawn(linear, quadratic, seed, noise, parity)
    negative, _ = Evidence(x, y, options, reflection)(theta)
    costs = [Bound(x, y, torch.arange(m), options, reflection)(theta)[0] for m in (1, 3, 8, 20)]
    assert costs == sorted(costs, reverse=True), "more inducing points never lower it"
    assert costs[-1] >= negative - 1e-9 * abs(negative)


@settings(max_examples=40)
@kernels
def test_with_all_points_as_inducing_points_the_bound_equals_the_marginal_likelihood(
    linear, quadratic, seed, noise, parity
):
    """But for the jitter, which is as small as 1e-9 of the prior's variance."""
    x, y, options, reflection, theta = drawn(linear, quadratic, seed, noise, parity)
    whole = Bound(x, y, torch.arange(len(y)), options, reflection)
    for ours, theirs in zip(whole(theta), Evidence(x, y, options, reflection)(theta), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-3)


class Reference(gpytorch.models.ExactGP):
    """GPyTorch's process through inducing points."""

    def __init__(self, x: Tensor, y: Tensor, z: Tensor, hyper: Hyperparameters) -> None:
        likelihood = gpytorch.likelihoods.GaussianLikelihood()
        likelihood.noise = hyper.noise_variance
        super().__init__(x, y, likelihood)
        self.mean_module = gpytorch.means.ZeroMean()
        smooth = ScaleKernel(RBFKernel(ard_num_dims=x.shape[1]))
        smooth.outputscale, smooth.base_kernel.lengthscale = hyper.signal_variance, hyper.lengthscale
        line = LinearKernel()
        line.variance = hyper.linear_variance
        constant = gpytorch.kernels.ConstantKernel()
        constant.constant = torch.tensor([hyper.linear_variance])
        self.covar_module = InducingPointKernel(smooth + line + constant, inducing_points=z, likelihood=likelihood)
        self.double()

    def forward(self, x: Tensor) -> gpytorch.distributions.MultivariateNormal:
        return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))


def test_the_sparse_bound_equals_that_of_gpytorch():
    x, y = points(60, 3, seed=0)
    hyper = Hyperparameters(torch.tensor([0.8, 1.7, 3.1], dtype=torch.float64), 1.6, 0.7, 0.0, 0.02)
    chosen = pivots(hyper, x, 12)
    bound = Bound(x, y, chosen, FitOptions(**WITHOUT_PRIORS), None)
    torch.set_default_dtype(torch.float64)
    try:
        with torch.no_grad(), gpytorch.settings.fast_computations(False, False, False):
            reference = Reference(x, y, x[chosen], hyper)
            reference.train()
            margin = gpytorch.mlls.ExactMarginalLogLikelihood(reference.likelihood, reference)
            theirs = float(margin(reference(x), y)) * len(y)
    finally:
        torch.set_default_dtype(torch.float32)
    assert bound.prior_constant - bound(bound.theta(hyper))[0] == pytest.approx(theirs, rel=1e-5)


def fitted(x: Tensor, y: Tensor, inducing: int) -> Posterior:
    start = fit(x[:100], y[:100], FitOptions()).theta
    return fit_bound(x, y, FitOptions(), start, inducing)


def test_a_sparse_fit_by_the_bound_recovers_function_and_noise():
    x, y = points(3_000, 2, seed=1)
    scale = y.std(correction=0)
    found, (at, _) = fitted(x, (y - y.mean()) / scale, 60), points(1_000, 2, seed=2)
    assert found.sparse is not None
    assert (found.sparse.points, len(found.y) <= 60) == (3_000, True)
    truth = (torch.sin(2 * at[:, 0]) + 0.5 * at[:, 1] - y.mean()) / scale
    assert float((found.mean(at) - truth).square().mean().sqrt()) < 0.3 * NOISE
    assert math.sqrt(found.hyper.noise_variance) * float(scale) == pytest.approx(NOISE, rel=0.05)


def test_variation_unexplained_by_inducing_points_is_learned_as_noise():
    """A fit to a subset would take six points for enough, and be sure of what they leave."""
    x, y = points(600, 2, seed=3)
    y = (y - y.mean()) / y.std(correction=0)
    few = fitted(x, y, 6)
    mean, variance = few.mean_and_variance(x)
    within = (mean - y).abs() <= 2 * (variance + few.hyper.noise_variance).sqrt()
    assert len(few.y) == 6
    assert float(within.double().mean()) > 0.9


def test_a_fit_with_as_many_inducing_points_as_samples_is_exact():
    x, y = points(40, 2, seed=4)
    found = fitted(x, y, 40)
    exact = condition(found.hyper, x, y)
    assert found.sparse is None
    torch.testing.assert_close(found.weights, exact.weights, rtol=0, atol=0)


def test_a_sparse_fit_leaves_out_irrelevant_inputs_unless_protected():
    x, y = points(1_500, 6, seed=5)
    y = (y - y.mean()) / y.std(correction=0)
    whole, may = fitted(x, y, 60), torch.ones(6, dtype=torch.bool)
    found = fewer_inputs(x, y, whole, FitOptions(), 60, may, -1.0)
    assert found is not None
    assert found.mask.tolist() == [True, True, False, False, False, False]
    assert found.posterior.x.shape[1] == 2
    may[4] = False
    again = fewer_inputs(x, y, whole, FitOptions(), 60, may, -1.0)
    assert again is not None
    assert again.mask.tolist() == [True, True, False, False, True, False]


def test_a_sparse_fit_keeps_relevant_inputs():
    x, y = points(1_500, 2, seed=6)
    y = (y - y.mean()) / y.std(correction=0)
    assert fewer_inputs(x, y, fitted(x, y, 60), FitOptions(), 60, torch.ones(2, dtype=torch.bool), -1.0) is None


def test_a_sparse_process_with_an_odd_kernel_never_drops_its_mirrored_input():
    """Of a function that is zero everywhere else nothing would be left."""
    x, _ = points(600, 2, seed=7)
    y = 0.01 * torch.from_numpy(np.random.default_rng(0).normal(size=600))
    odd = Reflection(torch.tensor([-1.0, 1.0], dtype=torch.float64), -1)
    hyper = Hyperparameters(torch.full((2,), 2.0, dtype=torch.float64), 1e-6, 1e-6, 0.0, 1e-2, odd)
    whole, may = condition_sparse(hyper, x, y, 30), torch.ones(2, dtype=torch.bool)
    found = fewer_inputs(x, y, whole, FitOptions(), 30, may, 100.0)
    assert found is None or bool(found.mask[0])


@pytest.mark.parametrize("parity", [0, -1])
def test_a_sparse_fit_of_noisy_points_predicts_as_well_as_the_exact_fit(parity: int):
    (x, y), (at, truth) = points(900, 3, 0), points(300, 3, 1)
    mirror = Reflection(-torch.ones(3, dtype=torch.float64), parity) if parity else None
    some = fit_some(x, y, FitOptions(), fit(x[:100], y[:100], FitOptions(), reflection=mirror).theta, mirror)
    few = fit_through_few(x, y, FitOptions(), some, mirror)
    assert few is not None
    assert few.points == 900
    assert len(few.y) < 150
    assert loses_nothing(few)
    whole = condition(few.hyper, x, y)
    for ours, theirs in zip(few.mean_and_variance(at), whole.mean_and_variance(at), strict=True):
        torch.testing.assert_close(ours.abs().sqrt(), theirs.abs().sqrt(), rtol=0, atol=0.1 * NOISE)
    assert few.left_out.error == pytest.approx(whole.left_out.error, rel=0.01)
    assert few.hyper.noise_variance == pytest.approx(NOISE**2, rel=0.15)
    assert float((few.mean(at) - truth).std()) < 1.1 * NOISE


@pytest.mark.parametrize("what", ["a kink", "few points", "rough"])
def test_no_sparse_fit_is_made_if_it_would_lose_accuracy(what: str):
    count = 300 if what == "few points" else 600
    x, y = points(count, 3, 0)
    if what == "a kink":
        y = x[:, 0].abs() + x[:, 1]
    if what == "rough":
        y = y + torch.sin(9 * x).prod(1)
    rows = spread(count, 150)
    some = fit_some(x, y, FitOptions(), fit(x[rows], y[rows], FitOptions()).theta)
    if what == "rough":
        some[:3] = math.log(0.1)
    assert fit_through_few(x, y, FitOptions(), some) is None


def test_a_noise_free_smooth_function_is_fitted_precisely_by_few_inducing_points():
    (x, _), (at, _) = points(900, 3, 0), points(300, 3, 1)

    def function(x: Tensor) -> Tensor:
        return x[:, 0] - 0.3 * x[:, 1] + torch.sin(x[:, 2])

    some = fit_some(x, function(x), FitOptions(), fit(x[:100], function(x[:100]), FitOptions()).theta)
    few = fit_through_few(x, function(x), FitOptions(), some)
    assert few is not None
    assert loses_nothing(few)
    assert len(few.y) < 50
    assert float((few.mean(at) - function(at)).abs().max()) < 1e-4
