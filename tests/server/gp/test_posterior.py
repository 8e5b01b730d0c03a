"""What is done to a posterior afterwards equals conditioning anew; singular data is repaired or refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from surrogym_server.errors import NumericalFailure
from surrogym_server.gp import condition, posterior
from surrogym_server.gp.posterior import MAX_JITTER, factorise


@pytest.fixture
def points(rng: np.random.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    x = torch.from_numpy(rng.normal(size=(14, 3)))
    return x, torch.sin(x[:, 0]) + 0.3 * x[:, 2]


def test_leave_one_out_predictions_equal_conditioning_without_the_point(hyper, points):
    x, y = points
    mean, variance = condition(hyper, x, y).leave_one_out()
    for i in range(len(y)):
        others = torch.arange(len(y)) != i
        left_mean, latent = condition(hyper, x[others], y[others]).mean_and_variance(x[i : i + 1])
        assert mean[i] == pytest.approx(float(left_mean), rel=1e-7, abs=1e-7)
        assert variance[i] == pytest.approx(float(latent) + hyper.noise_variance, rel=1e-6)


def test_extending_a_posterior_by_a_point_equals_conditioning_anew(hyper, points, rng):
    x, y = points
    at = torch.from_numpy(rng.normal(size=(20, 3)))
    extended = condition(hyper, x[:-2], y[:-2]).extend(x[-2], y[-2]).extend(x[-1], y[-1])
    anew = condition(hyper, x, y)
    torch.testing.assert_close(extended.factor, anew.factor, rtol=1e-9, atol=1e-9)
    for ours, theirs in zip(extended.mean_and_variance(at), anew.mean_and_variance(at), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-7, atol=1e-9)


def test_extending_a_posterior_leaves_the_old_one_unchanged(hyper, points):
    x, y = points
    before = condition(hyper, x, y)
    mean = before.mean(x)
    before.extend(x[0] + 1, y[0])
    assert len(before.y) == len(y)
    torch.testing.assert_close(before.mean(x), mean, rtol=0, atol=0)


def test_extending_a_posterior_repeatedly_by_one_point_stays_factorable(hyper, points):
    x, y = points
    repeated = condition(replace(hyper, noise_variance=1e-16), x, y).extend(x[0], y[0])
    assert float(repeated.factor[-1, -1]) > 0
    assert torch.isfinite(repeated.mean(x)).all()


def test_posterior_predictions_do_not_depend_on_the_block_size(hyper, points, rng, monkeypatch):
    x, y = points
    at = torch.from_numpy(rng.normal(size=(23, 3)))
    whole = condition(hyper, x, y).mean_and_variance(at)
    monkeypatch.setattr(posterior, "BLOCK", 5)
    for ours, theirs in zip(condition(hyper, x, y).mean_and_variance(at), whole, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-12)


def test_posterior_variance_is_never_negative_and_zero_noise_interpolates(hyper, points):
    x, y = points
    mean, variance = condition(replace(hyper, noise_variance=0.0), x, y).mean_and_variance(x)
    assert (variance >= 0).all()
    assert (variance < 1e-8).all()
    torch.testing.assert_close(mean, y, rtol=0, atol=1e-6)


def test_noise_free_duplicate_points_are_repaired_by_reported_jitter(hyper, points):
    x, y = points
    repaired = condition(replace(hyper, noise_variance=0.0), torch.cat([x, x]), torch.cat([y, y]))
    assert 0 < repaired.jitter < 1e-6
    torch.testing.assert_close(repaired.mean(x), y, rtol=0, atol=1e-3)


def test_jitter_is_raised_tenfold_only_until_the_covariance_can_be_factored():
    indefinite = torch.diag(torch.tensor([1.0, 1.0, -3e-8], dtype=torch.float64))
    factor, jitter = factorise(indefinite)
    assert jitter == pytest.approx(1e-7 * 2 / 3)
    torch.testing.assert_close(factor @ factor.T, indefinite + jitter * torch.eye(3, dtype=torch.float64))
    assert factorise(torch.eye(3, dtype=torch.float64))[1] == 0


def test_a_covariance_that_no_jitter_repairs_raises_a_numerical_error():
    hopeless = torch.diag(torch.tensor([1.0, -2 * MAX_JITTER], dtype=torch.float64))
    with pytest.raises(NumericalFailure, match="covariance matrix of 2 samples"):
        factorise(hopeless)
    with pytest.raises(NumericalFailure):
        factorise(torch.full((2, 2), torch.nan, dtype=torch.float64))


def test_the_joint_posterior_covariance_has_the_variances_on_its_diagonal(hyper, points, rng):
    """What is left of one point's variance after another is observed: by the joint covariance, and by extending."""
    x, y = points
    known = condition(hyper, x, y)
    sets = torch.from_numpy(rng.normal(size=(2, 5, 3)))
    joint = known.joint_covariance(sets)
    for part, own in zip(sets, joint, strict=True):
        torch.testing.assert_close(own.diagonal(), known.mean_and_variance(part)[1], rtol=1e-9, atol=1e-12)
        _, left = known.extend(part[0], y[0]).mean_and_variance(part[1:])
        expected = own.diagonal()[1:] - own[0, 1:].square() / (own[0, 0] + hyper.noise_variance)
        torch.testing.assert_close(left, expected, rtol=1e-7, atol=1e-10)
