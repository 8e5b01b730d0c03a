"""Samples of hyperparameters have the distribution that evidence and prior give them."""

import numpy as np
import pytest
import torch

from surrogym_server.gp import FitOptions, condition, fit, hyperparameter_samples
from surrogym_server.gp.search import Evidence


def wave(count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    x = torch.from_numpy(np.random.default_rng(seed).uniform(-1.7, 1.7, (count, 1)))
    y = (3 * x[:, 0]).sin()
    return x, (y - y.mean()) / y.std(correction=0)


def test_hyperparameters_survive_conversion_to_free_parameters_and_back(hyper):
    x = torch.from_numpy(np.random.default_rng(0).normal(size=(6, 3)))
    options = FitOptions(linear=hyper.linear_variance > 0, quadratic=hyper.quadratic_variance > 0)
    objective = Evidence(x, x[:, 0], options, hyper.reflection)
    back = objective.hyper(objective.theta(hyper))
    torch.testing.assert_close(back.lengthscale, hyper.lengthscale)
    for name in ("signal_variance", "linear_variance", "quadratic_variance", "noise_variance"):
        assert getattr(back, name) == pytest.approx(getattr(hyper, name))


def test_hyperparameter_samples_have_the_posterior_mean_computed_on_a_grid():
    """One point says nothing of two parameters but its own density, which a grid integrates."""
    x, y = torch.zeros(1, 1, dtype=torch.float64), torch.tensor([2.5], dtype=torch.float64)
    options = FitOptions(linear=False)
    objective = Evidence(x, y, options, None)
    signal, noise = np.meshgrid(np.linspace(-7, 7, 61), np.linspace(-18.4, 0.7, 61), indexing="ij")
    middle = objective.prior[0, 0]
    log = np.array([-objective(np.array([middle, *pair]))[0] for pair in zip(signal.flat, noise.flat, strict=True)])
    weight = np.exp(log - log.max())
    expected = float((weight @ signal.ravel()) / weight.sum())
    found = hyperparameter_samples(fit(x, y, options).posterior, 200, seed=0)
    logs = np.log([hyper.signal_variance for hyper in found])
    assert logs.mean() == pytest.approx(expected, abs=4 * logs.std() / np.sqrt(50))


def test_length_scale_samples_vary_more_with_fewer_points():
    spreads = []
    for count in (4, 30):
        found = hyperparameter_samples(fit(*wave(count, 1), FitOptions(linear=False)).posterior, 40, seed=0)
        spreads.append(float(torch.stack([hyper.lengthscale for hyper in found]).log().std()))
    assert spreads[0] > 3 * spreads[1]


def test_hyperparameter_samples_are_reproducible_from_points_and_seed():
    posterior = fit(*wave(6, 0), FitOptions()).posterior
    first, again, other = (hyperparameter_samples(posterior, 2, seed) for seed in (1, 1, 2))
    assert [h.noise_variance for h in first] == [h.noise_variance for h in again]
    assert [h.noise_variance for h in first] != [h.noise_variance for h in other]


def test_hyperparameter_samples_with_limited_noise_fit_a_narrow_step():
    """A kink between points looks like noise: functions with it pass far from the points, in narrow intervals."""
    x = torch.linspace(-1.7, 1.7, 25, dtype=torch.float64)[:, None]
    y = torch.where(x[:, 0].abs() < 0.15, 1.5, 0.0) + x[:, 0]
    y = (y - y.mean()) / y.std(correction=0)
    noisy = fit(x, y, FitOptions(), np.log([5.0, 1.0, 1.0, 0.2])).posterior
    limit = 1e-4
    assert noisy.hyper.noise_variance > 100 * limit
    for hyper in hyperparameter_samples(noisy, 8, seed=0, most_noise=limit):
        assert hyper.noise_variance <= limit
        assert float((condition(hyper, x, y).mean(x) - y).abs().max()) < 0.1
