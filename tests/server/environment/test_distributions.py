"""Quantiles of coordinates, the truncated normal's against SciPy, and the scaling of features."""

import numpy as np
import pytest
import torch
from scipy.stats import truncnorm

from surrogym_server.environment.distributions import FixedDefinition, NormalDefinition, UniformDefinition, scaling

P = torch.linspace(0, 1, 501, dtype=torch.float64)


@pytest.mark.parametrize(
    ("mean", "std", "low", "high"),
    [(0, 1, -3, 3), (2, 0.5, 1.5, 4), (0, 1, 1, 2), (-1, 3, -2, 17), (0, 1, -5.9, -4)],
)
def test_truncated_normal_quantiles_equal_those_of_scipy(mean, std, low, high):
    reference = truncnorm((low - mean) / std, (high - mean) / std, loc=mean, scale=std)
    values = NormalDefinition(mean, std, low, high).quantile(P).numpy()
    np.testing.assert_allclose(values, reference.ppf(P.numpy()), rtol=0, atol=1e-8 * std)
    assert np.all(np.diff(values) > 0)
    assert low <= values.min() < values.max() <= high


def test_quantiles_of_uniform_and_fixed_distributions_are_exact():
    torch.testing.assert_close(UniformDefinition(-2, 6).quantile(P), -2 + 8 * P)
    torch.testing.assert_close(FixedDefinition(1.5).quantile(P), torch.full_like(P, 1.5))
    assert (FixedDefinition(1.5).low, FixedDefinition(1.5).high) == (1.5, 1.5)


@pytest.mark.parametrize(
    "distribution", [UniformDefinition(-2, 6), NormalDefinition(1, 0.5, -0.5, 2.5), NormalDefinition(0, 2, -6, 6)]
)
def test_scaled_features_have_mean_zero_and_standard_deviation_near_one(distribution):
    centre, scale = scaling(distribution)
    scaled = (distribution.quantile((P[:-1] + P[1:]) / 2) - centre) / scale
    assert float(scaled.mean()) == pytest.approx(0, abs=1e-9)
    assert float(scaled.std()) == pytest.approx(1, abs=0.05)


def test_a_feature_with_a_fixed_value_is_scaled_to_zero():
    assert scaling(FixedDefinition(4.0)) == (4.0, 1.0)
