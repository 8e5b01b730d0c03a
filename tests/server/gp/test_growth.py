"""Processes whose roughness and amplitude grow along inputs, beside their covariance written out."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from surrogym_server.gp import FitOptions, covariance, fit, fit_growing
from surrogym_server.gp.growth import _GrowingObjective
from surrogym_server.tensors import amplitude, bend


def points(count: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Inputs, and values that are steep where the second input is large."""
    z = 3.4 * torch.rand(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 1.7
    return z, torch.exp(z[:, 1]) * torch.sin(2 * z[:, 0]) + 0.1 * z[:, 2]


ALL = torch.ones(3, dtype=torch.bool)


def test_the_gradient_of_the_objective_of_a_nonstationary_process_equals_finite_differences():
    z, t = points(20)
    objective = _GrowingObjective(z, t, torch.tensor([True, True, False]), FitOptions())
    theta = 0.3 * np.random.default_rng(0).standard_normal(objective.size)
    theta[objective.inner - 1] = -4.0
    for rates in (0.0, 1.0):  # at 0 the bent inputs are a limit
        theta[objective.inner :] = rates * np.array([0.4, -0.7])
        _, slopes = objective(theta)
        for index in range(objective.size):
            step = np.zeros(objective.size)
            step[index] = 1e-5
            difference = (objective(theta + step)[0] - objective(theta - step)[0]) / 2e-5
            assert slopes[index] == pytest.approx(difference, rel=1e-5, abs=1e-5)


def test_posterior_and_score_of_a_nonstationary_process_equal_the_explicit_formulas():
    """k_F(z, z') = a(z) k(w(z), w(z')) a(z'), with noise a(z)^2 sigma^2."""
    z, t = points(25)
    test, _ = points(7, seed=1)
    plain = fit(z, t, FitOptions())
    found = fit_growing(z, t, ALL, FitOptions(), [plain.theta])
    hyper, rates = found.fitted.posterior.hyper, torch.tensor(found.rates, dtype=torch.float64)
    a, b = (torch.exp(p @ rates) for p in (z, test))
    w, v = bend(z, rates), bend(test, rates)
    k = a[:, None] * covariance(hyper, w, w) * a + hyper.noise_variance * torch.diag(a.square())
    cross = b[:, None] * covariance(hyper, v, w) * a
    mean = cross @ torch.linalg.solve(k, t)
    variance = (b[:, None] * covariance(hyper, v, v) * b - cross @ torch.linalg.solve(k, cross.T)).diagonal()
    ours, spread = found.fitted.posterior.mean_and_variance(v)
    torch.testing.assert_close(amplitude(v, rates) * ours, mean, rtol=1e-6, atol=1e-8)
    torch.testing.assert_close(amplitude(v, rates).square() * spread, variance, rtol=1e-4, atol=1e-8)
    density = torch.distributions.MultivariateNormal(torch.zeros(len(t), dtype=torch.float64), k).log_prob(t)
    objective = _GrowingObjective(z, t, ALL, FitOptions())
    inner, _ = objective.plain(found.fitted.theta)
    theta, prior = found.fitted.theta[: objective.inner], inner.prior
    beyond = 0.5 * (((theta - prior[:, 0]) / prior[:, 1]) ** 2).sum() + np.log(prior[:, 1]).sum()
    beyond += 0.5 * float(rates.square().sum())
    assert found.fitted.score == pytest.approx(float(density) - beyond, abs=1e-5)


def test_a_nonstationary_process_predicts_a_growing_function_better_than_a_stationary_one():
    z, t = points(40)
    test, truth = points(500, seed=1)
    plain = fit(z, t, FitOptions())
    found = fit_growing(z, t, ALL, FitOptions(), [plain.theta])
    rates = torch.tensor(found.rates, dtype=torch.float64)
    w = bend(test, rates)
    with_rates = (amplitude(w, rates) * found.fitted.posterior.mean(w) - truth).abs().median()
    without = (plain.posterior.mean(test) - truth).abs().median()
    assert found.fitted.score > plain.score + 10
    assert 0.3 < found.rates[1] < 1.7
    assert float(with_rates) < 0.7 * float(without)


def test_a_nonstationary_process_grows_only_along_the_allowed_inputs():
    z, t = points(20)
    found = fit_growing(z, t, torch.tensor([True, False, False]), FitOptions(), [fit(z, t, FitOptions()).theta])
    assert found.rates[1:] == (0.0, 0.0)


def test_input_warping_and_amplitude_of_a_nonstationary_process_are_consistent():
    z, rates = points(9)[0], torch.tensor([0.0, 1.3, -0.4], dtype=torch.float64)
    w = bend(z, rates)
    torch.testing.assert_close(w[:, 0], z[:, 0])
    torch.testing.assert_close(amplitude(w, rates), torch.exp(z @ rates))
    assert float(w[:, 1].amin()) > -1 / 1.3
    assert math.isclose(float(bend(torch.tensor([1.0]), torch.tensor([1.0]))), math.e - 1, rel_tol=1e-6)


def test_combining_a_nonstationary_process_with_a_quadratic_kernel_is_refused():
    z, t = points(5)
    with pytest.raises(ValueError, match="quadratic"):
        fit_growing(z, t, ALL, FitOptions(quadratic=True), [])


def test_input_warping_far_outside_the_data_stays_finite_and_monotone():
    z = torch.linspace(-1e3, 1e3, 4001, dtype=torch.float64)[:, None].expand(-1, 2)
    rates = torch.tensor([2.0, -2.0], dtype=torch.float64)
    w = bend(z, rates)
    assert bool(torch.isfinite(w).all())
    assert bool((w.diff(dim=0) >= 0).all())
    assert bool((1 + w * rates > 0).all())
    steep = bend(torch.tensor([[2.0], [2.0 + 1e-6]], dtype=torch.float64), rates[:1])
    assert float(steep.diff(dim=0)) == pytest.approx(1e-6 * math.exp(4), rel=1e-4)


def test_fitting_a_nonstationary_process_to_inputs_beyond_two_deviations_is_refused():
    with pytest.raises(ValueError, match="at most 2"):
        fit_growing(torch.full((3, 1), 2.5, dtype=torch.float64), torch.zeros(3), ALL[:1], FitOptions(), [])
