"""Moments of PILCO agree with samples: processes, angles, the squashed policy and the cost."""

import numpy as np
import torch

from surrogym_lab.peers.methods.gaussian_process import (
    conditioned,
    fit,
    kernel,
    lowest,
    negative_log_evidence,
)
from surrogym_lab.peers.methods.moments import (
    saturating_cost,
    squashed,
    through_angles,
    through_processes,
)

DRAWS = 200_000


def belief(size, seed, scale=0.3):
    rng = np.random.default_rng(seed)
    root = scale * rng.standard_normal((2, size, size))
    mean = torch.from_numpy(rng.standard_normal((2, size)))
    return mean, torch.from_numpy(root @ root.transpose(0, 2, 1) + 0.01 * np.eye(size))


def draws(mean, covariance):
    noise = torch.randn(DRAWS, *mean.shape, dtype=mean.dtype, generator=torch.Generator().manual_seed(1))
    return mean + (torch.linalg.cholesky(covariance) @ noise[..., None])[..., 0]


def sampled(inputs, outputs, inputs_covariance):
    """Mean, covariance and gain of draws (S, K, .)."""
    x, y = inputs - inputs.mean(0), outputs - outputs.mean(0)
    cross = torch.einsum("ski,ske->kie", x, y) / len(x)
    return outputs.mean(0), torch.einsum("ske,skf->kef", y, y) / len(y), torch.linalg.solve(inputs_covariance, cross)


def agree(found, expected, tolerance=0.02):
    for got, wanted in zip((found.mean, found.covariance, found.gain), expected, strict=True):
        np.testing.assert_allclose(got, wanted, atol=tolerance, rtol=tolerance)


def processes(size=2, outputs=3, n=12):
    rng = np.random.default_rng(3)
    x = torch.from_numpy(rng.uniform(-2, 2, (n, size)))
    y = torch.from_numpy(rng.standard_normal((n, outputs)))
    lengthscale = torch.from_numpy(rng.uniform(0.7, 1.5, (outputs, size)))
    return conditioned(x, y, lengthscale, torch.tensor([1.0, 0.8, 1.2]).double(), torch.full((outputs,), 0.3).double())


def test_the_predicted_moments_of_gaussian_processes_equal_those_of_samples():
    model, (mean, covariance) = processes(), belief(2, 0)
    x = draws(mean, covariance)
    found = [model.predict(x[:, k]) for k in range(2)]
    means, deviations = (torch.stack(part, 1) for part in zip(*found, strict=True))
    noise = torch.randn(means.shape, dtype=means.dtype, generator=torch.Generator().manual_seed(2))
    agree(through_processes(model, mean, covariance), sampled(x, means + deviations * noise, covariance))
    agree(through_processes(model, mean, covariance, certain=True), sampled(x, means, covariance))


def test_the_moments_of_angle_encodings_equal_those_of_samples():
    mean, covariance = belief(2, 4)
    x = draws(mean, covariance)
    agree(through_angles(mean, covariance), sampled(x, torch.cat([x.sin(), x.cos()], -1), covariance))


def test_the_moments_of_a_squashed_control_equal_those_of_samples():
    mean, covariance = belief(2, 5)
    x = draws(mean, covariance)
    agree(squashed(mean, covariance), sampled(x, 9 / 8 * x.sin() + (3 * x).sin() / 8, covariance))


def test_the_expected_cost_equals_the_mean_cost_of_samples():
    mean, covariance = belief(2, 6)
    goal = torch.tensor([0.5, -0.2]).double()
    distance = ((draws(mean, covariance) - goal) ** 2).sum(-1)
    expected = (1 - torch.exp(-distance / (2 * 0.6**2))).mean(0)
    np.testing.assert_allclose(saturating_cost(mean, covariance, goal, 0.6), expected, atol=0.01, rtol=0.01)


def test_predictions_by_blocked_inverses_equal_the_explicit_formula():
    """Inverses in blocks of rows are the same as solving, with a number of samples that no block divides."""
    model, at = processes(n=150), torch.from_numpy(np.random.default_rng(4).uniform(-3, 3, (40, 2)))
    k = kernel(at, model.x, model.lengthscale, model.signal)
    mean, deviation = model.predict(at)
    np.testing.assert_allclose(mean, (k @ model.weights[..., None])[..., 0].T, atol=1e-9)
    explained = ((k @ model.inverse) * k).sum(-1)
    np.testing.assert_allclose(deviation**2, (model.signal[:, None] ** 2 - explained).T, atol=1e-9)


def test_the_gradient_of_the_log_marginal_likelihood_equals_finite_differences():
    rng = np.random.default_rng(6)
    x, y, theta = rng.uniform(-2, 2, (25, 3)), rng.standard_normal(25), rng.uniform(-1, 0.5, 5)
    _, slope = negative_log_evidence(x, y, theta)
    steps = 1e-5 * np.eye(5)
    rises = [negative_log_evidence(x, y, theta + h)[0] - negative_log_evidence(x, y, theta - h)[0] for h in steps]
    np.testing.assert_allclose(slope, np.array(rises) / 2e-5, rtol=1e-6, atol=1e-6)


def test_the_hyperparameter_search_continues_after_a_too_large_step():
    """The first step from 10 meets no value. A search that ended there would stay."""

    def objective(at):
        return (at[0] - np.log(at[0]), 1 - 1 / at) if at[0] > 0 else (np.nan, np.zeros(1))

    def steep(at):
        value, slope = objective(at)
        return 100 * value, 100 * slope

    np.testing.assert_allclose(lowest(steep, np.array([10.0])), 1, atol=1e-3)


def test_a_fitted_process_predicts_with_a_matching_deviation():
    rng = np.random.default_rng(0)
    x = rng.uniform(-2, 2, (60, 2))
    y = np.stack([np.sin(2 * x[:, 0]), 5 * x[:, 1] ** 2], 1) + 0.05 * rng.standard_normal((60, 2))
    model, at = fit(x, y, 1_000.0, rng), rng.uniform(-1.5, 1.5, (100, 2))
    mean, deviation = model.predict(torch.from_numpy(at))
    error = mean.numpy() - np.stack([np.sin(2 * at[:, 0]), 5 * at[:, 1] ** 2], 1)
    assert np.sqrt((error**2).mean(0)).max() < 0.1
    assert (np.abs(error) < 3 * deviation.numpy() + 0.05).mean() > 0.95
    assert model.noise[0] < 0.1
