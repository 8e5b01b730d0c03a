"""A thinned process predicts the same mean, within its tolerance, from fewer points, and keeps a mirror symmetry."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from surrogym_server.gp import Reflection, condition
from surrogym_server.gp.thinning import TOLERANCE, thinned


def sampled(rng: np.random.Generator, count: int) -> tuple[torch.Tensor, torch.Tensor]:
    x = torch.from_numpy(rng.uniform(-1, 1, size=(count, 3)))
    return x, torch.sin(x[:, 0]) + 0.3 * x[:, 2]


def test_the_mean_of_a_thinned_process_is_the_same_at_all_points_within_the_tolerance(hyper, rng):
    x, y = sampled(rng, 200)
    whole = condition(hyper, x, y)
    fewer = thinned(whole)
    assert 0 < len(fewer.x) < 100
    mean = whole.mean(x)
    assert float((fewer.mean(x) - mean).abs().max()) <= 1.01 * TOLERANCE * float(mean.std())
    between = torch.from_numpy(rng.uniform(-1, 1, size=(400, 3)))
    assert float((fewer.mean(between) - whole.mean(between)).abs().max()) < 10 * TOLERANCE * float(mean.std())


def test_a_thinned_process_is_that_of_its_points_without_noise(hyper, rng):
    fewer = thinned(condition(hyper, *sampled(rng, 80)))
    exact = condition(replace(hyper, noise_variance=0.0), fewer.x, fewer.y)
    torch.testing.assert_close(fewer.factor @ fewer.factor.T, exact.factor @ exact.factor.T, rtol=1e-9, atol=1e-9)
    at = torch.from_numpy(rng.normal(size=(20, 3)))
    torch.testing.assert_close(fewer.mean(at), exact.mean(at), rtol=1e-5, atol=1e-6)


def test_a_thinned_process_keeps_its_mirror_symmetry(hyper, rng):
    signs = torch.tensor([-1.0, 1.0, -1.0], dtype=torch.float64)
    odd = replace(hyper, reflection=Reflection(signs, -1))
    x, _ = sampled(rng, 60)
    fewer = thinned(condition(odd, x, torch.sin(2 * x[:, 0]) * (1 + x[:, 1])))
    assert len(fewer.x) < 60
    at = torch.from_numpy(rng.normal(size=(20, 3)))
    torch.testing.assert_close(fewer.mean(at * signs), -fewer.mean(at), rtol=1e-12, atol=1e-12)


def test_equal_points_and_a_mean_of_zero_are_no_trouble(hyper, rng):
    x, y = sampled(rng, 10)
    twice = condition(hyper, torch.cat([x, x]), torch.cat([y, y]))
    assert len(thinned(twice).x) <= 10
    idle = condition(hyper, x, torch.zeros(10, dtype=torch.float64))
    assert thinned(idle) is idle
