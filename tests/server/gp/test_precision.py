"""Ill-conditioned data (noise 1e-8, near-duplicates, long length scales) against 60 digits of mpmath.

The mean is within 1e-7 prior deviations, the variance within 1e-9 of the prior's plus 1e-3 of its own, whether by the
posterior or compiled for serving, with exponents by products (whatever their bound says) or by differences.
"""

import math

import mpmath
import numpy as np
import pytest
import torch

from surrogym_server.gp import Hyperparameters, Output, Posterior, Serving, condition, serving
from surrogym_server.tensors import to_device

DIGITS = 60
NOISE = 1e-8


def kernel(hyper: Hyperparameters, a: np.ndarray, b: np.ndarray) -> mpmath.mpf:
    a, b = [mpmath.mpf(float(v)) for v in a], [mpmath.mpf(float(v)) for v in b]
    scales = [mpmath.mpf(v) for v in hyper.lengthscale.tolist()]
    distance = mpmath.fsum(((p - q) / s) ** 2 for p, q, s in zip(a, b, scales, strict=True))
    smooth = hyper.signal_variance * mpmath.exp(-distance / 2)
    linear = hyper.linear_variance * (1 + mpmath.fdot(a, b))
    quadratic = hyper.quadratic_variance * mpmath.fsum((p * q) ** 2 for p, q in zip(a, b, strict=True))
    return smooth + linear + quadratic


def reference(hyper: Hyperparameters, x: np.ndarray, y: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Mean, variance and prior variance of each point of ``at``: (m, 3)."""
    n = len(x)
    k = mpmath.matrix(n, n)
    for i in range(n):
        for j in range(i + 1):
            k[i, j] = k[j, i] = kernel(hyper, x[i], x[j])
        k[i, i] += mpmath.mpf(hyper.noise_variance)
    inverse, rows = k**-1, []
    weights = inverse * mpmath.matrix(y.tolist())
    for point in at:
        cross = mpmath.matrix([kernel(hyper, point, row) for row in x])
        prior = kernel(hyper, point, point)
        rows.append([(cross.T * weights)[0], prior - (cross.T * inverse * cross)[0], prior])
    return np.array([[float(v) for v in row] for row in rows])


def served(posterior: Posterior, at: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    compiled = Serving.of([Output(0, posterior, (0, 1))], columns=1, width=2, device=at.device)
    mean, std = compiled.mean_and_std(at, [0])
    torch.testing.assert_close(compiled.mean(at), mean, rtol=0, atol=0)
    return mean[:, 0], std[:, 0].square()


@pytest.mark.parametrize("length", [0.5, 2.0, 20.0])
@pytest.mark.parametrize(("linear", "quadratic"), [(0.0, 0.0), (0.7, 0.3)])
def test_the_posterior_of_ill_conditioned_data_agrees_with_mpmath(rng, monkeypatch, device, length, linear, quadratic):
    x = rng.normal(size=(12, 2))
    x = np.concatenate([x, x[:4] + 1e-4 * rng.normal(size=(4, 2)), x[:4] + 1e-6 * rng.normal(size=(4, 2))])
    y = np.sin(x[:, 0]) + 0.4 * x.sum(1) - 0.2 * x[:, 1] ** 2
    at = np.concatenate([rng.normal(size=(12, 2)), x[:3], x[:3] + 1e-3])
    hyper = Hyperparameters(length * torch.tensor([1.0, 1.5], dtype=torch.float64), 1.3, linear, quadratic, NOISE)
    with mpmath.workdps(DIGITS):
        mean, variance, prior = reference(hyper, x, y, at).T
    posterior = to_device(condition(hyper, torch.from_numpy(x), torch.from_numpy(y)), device)
    assert posterior.jitter == 0
    points = torch.from_numpy(at).to(device)
    predictions = [posterior.mean_and_variance(points), served(posterior, points)]
    for tolerance in (0.0, math.inf):
        monkeypatch.setattr(serving, "MEAN_TOLERANCE", tolerance)
        monkeypatch.setattr(serving, "VARIANCE_TOLERANCE", tolerance)
        predictions.append(served(posterior, points))
    for ours, latent in ((m.cpu().numpy(), v.cpu().numpy()) for m, v in predictions):
        assert np.max(np.abs(ours - mean) / np.sqrt(prior)) < 1e-7
        assert np.all(np.abs(latent - variance) <= 1e-9 * prior + 1e-3 * variance)
