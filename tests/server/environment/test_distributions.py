"""Quantiles of coordinates, the truncated normal's against SciPy, and the scaling of features."""

import numpy as np
import pytest
import torch
from scipy.stats import truncnorm

from surrogym_server.environment.distributions import quantile, scaling
from surrogym_shared.spec import Fixed, Normal, Uniform, limits

P = torch.linspace(0, 1, 501, dtype=torch.float64)


@pytest.mark.parametrize(
    ("mean", "std", "low", "high"),
    [(0, 1, -3, 3), (2, 0.5, 1.5, 4), (0, 1, 1, 2), (-1, 3, -2, 17), (0, 1, -5.9, -4)],
)
def test_truncated_normal_quantiles_equal_those_of_scipy(mean, std, low, high):
    reference = truncnorm((low - mean) / std, (high - mean) / std, loc=mean, scale=std)
    values = quantile(Normal(mean=mean, std=std, low=low, high=high), P).numpy()
    np.testing.assert_allclose(values, reference.ppf(P.numpy()), rtol=0, atol=1e-8 * std)
    assert np.all(np.diff(values) > 0)
    assert low <= values.min() < values.max() <= high


def test_quantiles_of_uniform_and_fixed_distributions_are_exact():
    torch.testing.assert_close(quantile(Uniform(low=-2, high=6), P), -2 + 8 * P)
    torch.testing.assert_close(quantile(Fixed(value=1.5), P), torch.full_like(P, 1.5))
    assert limits(Fixed(value=1.5)) == (1.5, 1.5)


@pytest.mark.parametrize(
    "distribution", [Uniform(low=-2, high=6), Normal(mean=1, std=0.5, low=-0.5, high=2.5), Normal(mean=0, std=2)]
)
def test_scaled_features_have_mean_zero_and_standard_deviation_near_one(distribution):
    centre, scale = scaling(distribution)
    scaled = (quantile(distribution, (P[:-1] + P[1:]) / 2) - centre) / scale
    assert float(scaled.mean()) == pytest.approx(0, abs=1e-9)
    assert float(scaled.std()) == pytest.approx(1, abs=0.05)


def test_a_feature_with_a_fixed_value_is_scaled_to_zero():
    assert scaling(Fixed(value=4.0)) == (4.0, 1.0)
