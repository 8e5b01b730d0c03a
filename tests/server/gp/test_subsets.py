"""Fits of many points: hyperparameters of some of them, and processes that predict as those of all."""

from __future__ import annotations

import math
import sys

import numpy as np
import pytest
import torch

from surrogym_server.gp import (
    FitOptions,
    condition,
    condition_sparse,
    fit,
    fit_some,
    refine,
    refine_where_hard,
    spread,
    subsets,
)
from surrogym_server.gp.search import Evidence, minimum


@pytest.mark.parametrize("points", [1, 30, 31, 1_000])
def test_a_subset_takes_one_point_of_each_equal_stretch_of_the_sequence(points: int):
    rows = spread(points, 30)
    assert len(rows) == len(rows.unique()) == min(points, 30)
    stretch = points / len(rows)
    for place, row in enumerate(rows.tolist()):
        assert int(place * stretch) <= row < (place + 1) * stretch
    assert torch.equal(rows, spread(points, 30))


def test_a_subset_samples_every_phase_of_a_periodic_sequence():
    assert len((spread(3_000, 150) % 20).unique()) > 10


def smooth(points: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(seed)
    x = torch.from_numpy(rng.uniform(-1.7, 1.7, (points, 3)))
    y = torch.sin(2 * x[:, 0]) + 0.5 * x[:, 1] * x[:, 0] + 0.3 * x[:, 2]
    return x, y + torch.from_numpy(0.02 * rng.normal(size=points))


def test_hyperparameters_refined_from_few_points_predict_as_those_fitted_to_all():
    (x, y), (at, truth) = smooth(500, 0), smooth(300, 1)
    few = spread(len(y), subsets.FEW)
    some = fit_some(x, y, FitOptions(), fit(x[few], y[few], FitOptions()).theta)
    refined = condition(refine(x, y, FitOptions(), some)[-1], x, y)
    full = fit(x, y, FitOptions()).posterior
    for ours, theirs in zip(refined.mean_and_variance(at), full.mean_and_variance(at), strict=True):
        torch.testing.assert_close(ours.abs().sqrt(), theirs.abs().sqrt(), rtol=0, atol=3e-3)
    assert refined.left_out.error == pytest.approx(full.left_out.error, rel=0.02)
    assert refined.hyper.noise_variance == pytest.approx(full.hyper.noise_variance, rel=0.1)
    assert float((refined.mean(at) - truth).std()) < 0.03


def test_refining_with_more_points_explains_a_wave_mistaken_for_noise():
    """From where few points end, the search ends in noise; the second start finds the wave."""
    x = torch.linspace(-1.7, 1.7, 200, dtype=torch.float64)[:, None]
    y, found = torch.sin(6 * x[:, 0]), np.array([0.7, 0.0, -10.0, 0.0])  # as theta: the last is log sigma_n^2
    _, alone = minimum(Evidence(x, y, FitOptions(), None), found)
    assert math.exp(alone[-1]) > 0.1
    assert refine(x, y, FitOptions(), fit_some(x, y, FitOptions(), found))[-1].noise_variance < 1e-4


def test_refining_with_the_hardest_points_improves_a_steep_region(monkeypatch: pytest.MonkeyPatch):
    """One in 25 points lies where the function is steep, and as many points drawn evenly hardly meet it."""
    monkeypatch.setattr(sys.modules[refine_where_hard.__module__], "HARD", 60)
    x = 3.4 * torch.rand(1_500, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) - 1.7
    y, options = steep(x), FitOptions()
    few = spread(len(y), 60)
    even = condition_sparse(fit(x[few], y[few], options).posterior.hyper, x, y)
    hard = condition_sparse(refine_where_hard(even, x, y, options), x, y)
    at = torch.linspace(-1.7, 1.7, 500, dtype=torch.float64)[:, None]
    errors = [float((one.mean(at) - steep(at)).square().mean().sqrt()) for one in (even, hard)]
    assert errors[1] < 0.3 * errors[0]
    assert hard.left_out.error < even.left_out.error


def steep(x: torch.Tensor) -> torch.Tensor:
    return 0.3 * x[:, 0] + torch.tanh(40 * (x[:, 0] - 1.6))
