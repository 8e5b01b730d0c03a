"""A process through inducing points is the exact one where they say enough, and tells what it loses where not."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from surrogym_server.gp import (
    Hyperparameters,
    Output,
    Pathwise,
    Posterior,
    Serving,
    condition,
    condition_sparse,
    sparse,
    spread,
)

NOISE = 1e-4


def function(x: Tensor) -> Tensor:
    return torch.sin(2 * x[:, 0]) + x[:, 1]


@pytest.fixture
def drawn() -> tuple[Hyperparameters, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    x = 3.4 * torch.rand(400, 2, dtype=torch.float64, generator=generator) - 1.7
    y = function(x) + math.sqrt(NOISE) * torch.randn(400, dtype=torch.float64, generator=generator)
    return Hyperparameters(torch.full((2,), 1.5, dtype=torch.float64), 1.0, 0.5, 0.0, NOISE), x, y


def test_few_inducing_points_predict_as_all_points_do(drawn: tuple[Hyperparameters, Tensor, Tensor]):
    hyper, x, y = drawn
    exact, through = condition(hyper, x, y), condition_sparse(hyper, x, y)
    assert through.sparse is not None
    assert (through.sparse.points, len(through.y) < 120, through.sparse.unexplained < 1e-3) == (400, True, True)
    at = 4 * torch.rand(200, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) - 2
    for ours, theirs in zip(through.mean_and_variance(at), exact.mean_and_variance(at), strict=True):
        torch.testing.assert_close(ours.abs().sqrt(), theirs.abs().sqrt(), rtol=0, atol=1e-3)


def test_too_few_say_what_is_lost_and_are_not_sure_of_it(
    drawn: tuple[Hyperparameters, Tensor, Tensor], monkeypatch: pytest.MonkeyPatch
):
    hyper, x, y = drawn
    monkeypatch.setattr(sparse, "INDUCING", 12)
    through = condition_sparse(hyper, x, y)
    assert through.sparse is not None
    assert len(through.y) == 12
    assert through.sparse.unexplained > 0.01
    mean, variance = through.mean_and_variance(x)
    error = (mean - function(x)).square().mean().sqrt()
    assert float(error) < 3 * float(variance.mean().sqrt())


def test_it_is_served_extended_and_drawn_from_as_any_other(drawn: tuple[Hyperparameters, Tensor, Tensor]):
    through = condition_sparse(*drawn)
    at = torch.tensor([[0.3, -0.4], [2.5, 1.0]], dtype=torch.float64)
    mean, variance = through.mean_and_variance(at)
    served, deviation = Serving.of([Output(0, through, (0, 1))], 1, 2).mean_and_deviation(at, (0,))
    torch.testing.assert_close(served[:, 0], mean, rtol=0, atol=1e-8)
    torch.testing.assert_close(deviation[:, 0].square(), variance, rtol=1e-3, atol=1e-8)
    extended = through.extend(at[1], function(at)[1])
    assert extended.mean(at)[1] == pytest.approx(float(function(at)[1]), abs=1e-2)
    assert extended.mean_and_variance(at)[1][1] < variance[1]
    assert spread_of_draws(through, at[1]) == pytest.approx(spread_of_draws(condition(*drawn), at[1]), rel=0.1)


def spread_of_draws(posterior: Posterior, at: Tensor) -> float:
    pathwise = Pathwise(posterior)
    noise = torch.randn(2_000, pathwise.size, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    return float(pathwise.residual(at.expand(2_000, 2), pathwise.draw(noise)).std())


@pytest.mark.parametrize(
    ("points", "taken"), [(sparse.MAX_EXACT, sparse.MAX_EXACT), (sparse.MAX_EXACT + 1, sparse.FITTED)]
)
def test_hyperparameters_see_all_points_or_an_even_share(points: int, taken: int):
    rows = spread(points)
    assert (len(rows.unique()), int(rows[0]), int(rows[-1])) == (taken, 0, points - 1)
