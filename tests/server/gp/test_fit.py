"""Hyperparameters: the gradient is that of the objective, the objective the evidence, and its optimum is found."""

import math
import subprocess
import sys
import warnings

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, DotProduct, WhiteKernel

from surrogym_server.gp import FitOptions, Reflection, fit, noisy_explanation
from surrogym_server.gp.search import Evidence

FLAT = (0.0, 1e4)  # a prior that says nothing
WITHOUT_PRIORS = {f"{name}_prior": FLAT for name in ("lengthscale", "signal", "linear", "quadratic", "noise")}


def draw(rng: np.random.Generator, n: int, lengths: list[float], noise: float) -> tuple[torch.Tensor, torch.Tensor]:
    """A draw from a squared exponential of unit variance."""
    x = rng.normal(size=(n, len(lengths)))
    k = RBF(np.array(lengths))(x) + noise * np.eye(n)
    return torch.from_numpy(x), torch.from_numpy(np.linalg.cholesky(k) @ rng.normal(size=n))


@settings(max_examples=40)
@given(
    linear=st.booleans(),
    quadratic=st.booleans(),
    seed=st.integers(0, 2**32 - 1),
    noise=st.floats(-6.0, 0.0),
    parity=st.sampled_from([0, 1, -1]),
)
def test_the_gradient_of_the_fit_objective_equals_finite_differences(linear, quadratic, seed, noise, parity):
    rng = np.random.default_rng(seed)
    x, y = draw(rng, 12, [1.0, 2.0], 0.1)
    reflection = Reflection(torch.tensor([-1.0, 1.0], dtype=torch.float64), parity) if parity else None
    objective = Evidence(x, y, FitOptions(linear=linear, quadratic=quadratic), reflection)
    theta = rng.uniform(-1.5, 1.5, len(objective.default_start))
    theta[-1] = noise
    _, gradient = objective(theta)
    step = 1e-5
    for i, direction in enumerate(np.eye(len(theta))):
        difference = (objective(theta + step * direction)[0] - objective(theta - step * direction)[0]) / (2 * step)
        assert gradient[i] == pytest.approx(difference, rel=1e-4, abs=1e-4)


@pytest.mark.parametrize("linear", [False, True])
def test_without_hyperparameter_priors_the_objective_equals_scikit_learns_marginal_likelihood(rng, linear):
    x, y = draw(rng, 20, [0.7, 3.0], 1e-3)
    kernel = ConstantKernel(1.4) * RBF([0.9, 2.0])
    theta = [0.9, 2.0, 1.4]
    if linear:
        kernel += ConstantKernel(0.6) * DotProduct(1.0)
        theta.append(0.6)
    reference = GaussianProcessRegressor(kernel, alpha=1e-3, optimizer=None).fit(x.numpy(), y.numpy())
    objective = Evidence(x, y, FitOptions(linear=linear, **WITHOUT_PRIORS), None)
    constant = (len(theta) + 1) * math.log(1e4)
    value, _ = objective(np.log([*theta, 1e-3]))
    assert -(value - constant) == pytest.approx(reference.log_marginal_likelihood_value_, rel=1e-6)


def test_the_objective_of_a_singular_covariance_is_huge(rng):
    x, y = draw(rng, 10, [1.0], 1e-2)
    objective = Evidence(x, y, FitOptions(linear=False), None)
    theta = np.array([40.0, 40.0, -80.0])  # all points alike, far outside the bounds
    value, gradient = objective(theta)
    assert value == 1e10
    assert not gradient.any()


def test_hyperparameter_priors_change_the_score_by_their_log_density(rng):
    x, y = draw(rng, 10, [1.0], 1e-2)
    vague = Evidence(x, y, FitOptions(linear=False, **WITHOUT_PRIORS), None)
    informed = Evidence(x, y, FitOptions(linear=False, **(WITHOUT_PRIORS | {"signal_prior": (0.5, 0.25)})), None)
    theta = np.array([0.0, 1.0, -3.0])
    expected = 0.5 * ((1.0 - 0.5) / 0.25) ** 2 + math.log(0.25) - math.log(1e4)
    assert informed(theta)[0] - vague(theta)[0] == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_the_fitted_marginal_likelihood_is_at_least_that_of_scikit_learn(seed):
    x, y = draw(np.random.default_rng(seed), 40, [0.7, 3.0], 1e-2)
    kernel = ConstantKernel(1.0, (1e-8, 1e4)) * RBF([1.0, 1.0], (0.02, 1e3)) + WhiteKernel(1e-2, (1e-8, 2.0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        regressor = GaussianProcessRegressor(kernel, alpha=0, n_restarts_optimizer=2, random_state=0)
        theirs = regressor.fit(x.numpy(), y.numpy()).log_marginal_likelihood_value_
    ours = fit(x, y, FitOptions(linear=False, **WITHOUT_PRIORS), None).score + 4 * math.log(1e4)
    assert ours >= theirs - 1e-3


def test_a_fit_recovers_the_length_scales_and_noise_that_generated_its_points(rng):
    x, y = draw(rng, 120, [0.7, 2.5], 1e-2)
    hyper = fit(x, y, FitOptions(linear=False)).posterior.hyper
    assert hyper.lengthscale.tolist() == pytest.approx([0.7, 2.5], rel=0.35)
    assert hyper.noise_variance == pytest.approx(1e-2, rel=0.6)


def test_an_irrelevant_input_gets_a_long_length_scale(rng):
    x = torch.from_numpy(rng.normal(size=(40, 2)))
    short, long = fit(x, torch.sin(3 * x[:, 0]), FitOptions(linear=False)).posterior.hyper.lengthscale.tolist()
    assert long > 5 * short


def test_with_a_linear_kernel_a_linear_function_is_predicted_exactly(rng):
    x, at = (torch.from_numpy(rng.normal(size=(n, 3))) for n in (8, 50))
    slope = torch.tensor([0.5, -0.3, 0.2], dtype=torch.float64)
    fitted = fit(x, x @ slope, FitOptions())
    assert fitted.posterior.hyper.kernel == "squared exponential + linear"
    assert float((fitted.posterior.mean(at) - at @ slope).abs().max()) < 5e-3


def test_a_warm_start_never_lowers_the_fitted_score(rng):
    x, y = draw(rng, 15, [1.0, 1.0], 1e-3)
    cold = fit(x, y, FitOptions())
    assert fit(x, y, FitOptions(), cold.theta).score >= cold.score
    assert fit(x, y, FitOptions(), np.full_like(cold.theta, 50.0)).score >= cold.score - 1e-9


def test_fits_of_constant_outputs_and_repeated_points_stay_finite(rng):
    x = torch.from_numpy(rng.normal(size=(6, 2)))
    for inputs, targets in ((x, torch.zeros(6, dtype=torch.float64)), (torch.cat([x, x]), torch.cat([x, x])[:, 0])):
        fitted = fit(inputs, targets, FitOptions())
        mean, variance = fitted.posterior.mean_and_variance(inputs)
        assert math.isfinite(fitted.score)
        assert torch.isfinite(mean).all()
        assert torch.isfinite(variance).all()
        torch.testing.assert_close(mean, targets, rtol=0, atol=1e-2)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_noise_with_a_fifth_of_the_output_variance_is_detected(seed):
    rng = np.random.default_rng(seed)
    x = torch.tensor(rng.uniform(-1.7, 1.7, (60, 3)))
    y = x[:, 1] + torch.tensor(0.5 * rng.standard_normal(60))
    y = (y - y.mean()) / y.std(correction=0)
    assert 0.05 < fit(x, y, FitOptions()).posterior.hyper.noise_variance < 0.5


LIMITED = """
import torch
from surrogym_server.gp import FitOptions, fit
from surrogym_server.gp.search import blas
x = torch.linspace(0, 1, 8, dtype=torch.float64)[:, None]
fit(x, x[:, 0].sin(), FitOptions())
from threadpoolctl import ThreadpoolController
def libraries(controller):
    return {library.filepath for library in controller.lib_controllers if library.user_api == "blas"}
print(libraries(ThreadpoolController()) - libraries(blas()))
"""


def test_the_first_fit_in_a_process_limits_the_threads_of_every_blas():
    """SciPy's own library is loaded on first use, and a controller knows only what was loaded before it."""
    ran = subprocess.run([sys.executable, "-c", LIMITED], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "set()"


def test_repeated_points_let_a_warm_started_fit_detect_the_noise(rng):
    """A fit to points of one result each has explained the noise by short length scales."""
    x = torch.from_numpy(rng.uniform(-1, 1, (28, 2)))
    y = x[:, 0] + 0.3 * torch.from_numpy(rng.normal(size=28))
    stuck = np.log(np.array([0.02, 0.02, 1.0, 1e-8, 1e-7]))
    again = torch.cat([x, x[:3]]), torch.cat([y, y[:3] + 0.3 * torch.from_numpy(rng.normal(size=3))])
    cold, warm = (fit(*again, FitOptions(), warm=start) for start in (None, stuck))
    assert warm.score == pytest.approx(cold.score, abs=0.1)
    assert math.sqrt(warm.posterior.hyper.noise_variance) == pytest.approx(0.3, rel=0.4)
    assert fit(x[:27], y[:27], FitOptions(), warm=stuck).posterior.hyper.noise_variance < 1e-2, "without, it is stuck"


def test_the_noise_of_an_output_is_found_even_if_the_fit_is_in_a_noise_free_local_optimum(rng):
    x = torch.from_numpy(rng.uniform(-1, 1, (27, 2)))
    y = x[:, 0] + 0.3 * torch.from_numpy(rng.normal(size=27))
    stuck = np.log(np.array([0.02, 0.02, 1.0, 1e-8, 1e-7]))
    assert math.sqrt(noisy_explanation(fit(x, y, FitOptions(), warm=stuck).posterior, FitOptions())) > 0.15
    smooth = fit(x, x[:, 0] ** 2, FitOptions()).posterior
    assert noisy_explanation(smooth, FitOptions()) < 1e-6, "an exact function has none"
