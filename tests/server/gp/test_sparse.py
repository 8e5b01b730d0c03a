"""A process through inducing points is the exact one where they say enough, and tells what it loses where not."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from surrogym_server.gp import (
    Censored,
    Hyperparameters,
    Output,
    Pathwise,
    Posterior,
    Serving,
    condition,
    condition_many,
    condition_sparse,
    sparse,
)
from surrogym_server.gp.kernel import covariance

NOISE = 1e-4


def function(x: Tensor) -> Tensor:
    return torch.sin(2 * x[:, 0]) + x[:, 1]


@pytest.fixture
def drawn() -> tuple[Hyperparameters, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    x = 3.4 * torch.rand(400, 2, dtype=torch.float64, generator=generator) - 1.7
    y = function(x) + math.sqrt(NOISE) * torch.randn(400, dtype=torch.float64, generator=generator)
    return Hyperparameters(torch.full((2,), 1.5, dtype=torch.float64), 1.0, 0.5, 0.0, NOISE), x, y


def test_a_sparse_process_predicts_as_the_exact_process_does(drawn: tuple[Hyperparameters, Tensor, Tensor]):
    hyper, x, y = drawn
    exact, through = condition(hyper, x, y), condition_sparse(hyper, x, y)
    assert through.sparse is not None
    assert (through.sparse.points, len(through.y) < 120, through.sparse.unexplained < 1e-3) == (400, True, True)
    at = 4 * torch.rand(200, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) - 2
    for ours, theirs in zip(through.mean_and_variance(at), exact.mean_and_variance(at), strict=True):
        torch.testing.assert_close(ours.abs().sqrt(), theirs.abs().sqrt(), rtol=0, atol=1e-3)


def test_a_process_with_too_few_inducing_points_reports_larger_uncertainty(
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


def test_a_sparse_process_can_be_served_extended_and_drawn_from(drawn: tuple[Hyperparameters, Tensor, Tensor]):
    through = condition_sparse(*drawn)
    at = torch.tensor([[0.3, -0.4], [2.5, 1.0]], dtype=torch.float64)
    mean, variance = through.mean_and_variance(at)
    served, std = Serving.of([Output(0, through, (0, 1))], 1, 2).mean_and_std(at, (0,))
    torch.testing.assert_close(served[:, 0], mean, rtol=0, atol=1e-8)
    torch.testing.assert_close(std[:, 0].square(), variance, rtol=1e-3, atol=1e-8)
    extended = through.extend(at[1], function(at)[1])
    assert extended.mean(at)[1] == pytest.approx(float(function(at)[1]), abs=1e-2)
    assert extended.mean_and_variance(at)[1][1] < variance[1]
    assert spread_of_draws(through, at[1]) == pytest.approx(spread_of_draws(condition(*drawn), at[1]), rel=0.1)


def spread_of_draws(posterior: Posterior, at: Tensor) -> float:
    pathwise = Pathwise(posterior)
    noise = torch.randn(2_000, pathwise.size, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    return float(pathwise.residual(at.expand(2_000, 2), pathwise.draw(noise)).std())


@pytest.mark.parametrize(("points", "exact"), [(60, True), (61, False)])
def test_a_process_becomes_sparse_beyond_a_number_of_points(
    drawn: tuple[Hyperparameters, Tensor, Tensor], points: int, exact: bool, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(sparse, "MAX_EXACT", 60)
    hyper, x, y = drawn
    assert (condition_many([hyper], x[:points], y[:points]).sparse is None) == exact


def test_a_sparse_process_corrects_an_underestimated_noise_variance(
    drawn: tuple[Hyperparameters, Tensor, Tensor], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(sparse, "MAX_EXACT", 60)
    hyper, x, y = drawn
    for fitted in (NOISE, NOISE / 100):
        found = condition_many([replace(hyper, noise_variance=fitted)], x, y)
        assert found.hyper.noise_variance == pytest.approx(NOISE)


def test_the_sparse_process_that_predicts_all_points_best_is_kept(
    drawn: tuple[Hyperparameters, Tensor, Tensor], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(sparse, "MAX_EXACT", 60)
    hyper, x, y = drawn
    rough = replace(hyper, lengthscale=hyper.lengthscale / 20)
    for order in ([hyper, rough], [rough, hyper]):
        assert condition_many(order, x, y).hyper.lengthscale is hyper.lengthscale


def test_censored_points_count_in_choosing_a_sparse_process(
    drawn: tuple[Hyperparameters, Tensor, Tensor], monkeypatch: pytest.MonkeyPatch
):
    """Both foretell the points alike, with a linear part slightly better. Beyond them it leads away."""
    monkeypatch.setattr(sparse, "MAX_EXACT", 60)
    hyper, x, y = drawn
    flat = replace(hyper, linear_variance=1e-9)
    beyond = torch.tensor([[0.0, 6.0], [0.5, 7.0]], dtype=torch.float64)
    at_most = Censored(beyond, beyond.new_ones(2), -beyond.new_ones(2))
    for order in ([hyper, flat], [flat, hyper]):
        assert condition_many(order, x, y).hyper.linear_variance == hyper.linear_variance
        assert condition_many(order, x, y, at_most).hyper.linear_variance == flat.linear_variance


def test_the_earlier_sparse_process_is_kept_unless_a_new_one_predicts_better(
    drawn: tuple[Hyperparameters, Tensor, Tensor], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(sparse, "MAX_EXACT", 60)
    hyper, x, y = drawn
    rough = replace(hyper, lengthscale=hyper.lengthscale / 20)
    good, bad = condition_many([hyper], x, y), condition_many([rough], x, y)
    assert condition_many([rough], x, y, earlier=good) is good
    assert condition_many([hyper], x, y, earlier=bad).hyper.lengthscale is hyper.lengthscale


def test_the_hardest_points_are_isolated_or_have_large_residuals(drawn: tuple[Hyperparameters, Tensor, Tensor]):
    hyper, x, y = drawn
    lone = torch.cat([x, torch.tensor([[6.0, 6.0]], dtype=torch.float64)])
    off = torch.cat([y, y.new_zeros(1)]).index_add(0, torch.tensor([7, 250]), y.new_tensor([5.0, -5.0]))
    found = sparse.hardest(condition_sparse(hyper, lone, off), lone, off, 20).tolist()
    assert len(set(found)) == 20
    assert 400 in found[:10]
    assert {7, 250} <= set(found)


def test_leave_one_out_errors_of_a_sparse_process_are_computed_for_all_points(
    drawn: tuple[Hyperparameters, Tensor, Tensor],
):
    exact, through = condition(*drawn).left_out, condition_sparse(*drawn).left_out
    assert through.error == pytest.approx(exact.error, rel=1e-3)
    assert through.within_one == pytest.approx(exact.within_one, abs=0.01)
    assert through.within_two == pytest.approx(exact.within_two, abs=0.01)


def test_leave_one_out_errors_include_what_inducing_points_cannot_explain(
    drawn: tuple[Hyperparameters, Tensor, Tensor], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(sparse, "INDUCING", 12)
    hyper, x, y = drawn
    at, _, _ = sparse._pivots(hyper, x)
    through, errors, within = condition_sparse(hyper, x, y), [], []
    for i in range(len(y)):
        others = torch.arange(len(y)) != i
        mean, variance = _projected(hyper, x[others], y[others], x[at], x[i : i + 1])
        errors.append(float(mean - y[i]))
        within.append(abs(errors[-1]) <= math.sqrt(variance + NOISE))
    assert through.left_out.error == pytest.approx(math.sqrt(sum(e * e for e in errors) / len(errors)), rel=1e-4)
    assert through.left_out.within_one == pytest.approx(sum(within) / len(within), abs=0.005)


def _projected(hyper: Hyperparameters, x: Tensor, y: Tensor, z: Tensor, at: Tensor) -> tuple[Tensor, float]:
    """Mean and latent variance at one point, by the equations of Rasmussen and Williams (2006), section 8.3.4."""
    inner, outer, prior = covariance(hyper, z, z), covariance(hyper, z, x), covariance(hyper, at, at)
    known = hyper.noise_variance * inner + outer @ outer.T
    k = covariance(hyper, z, at)
    mean = k.T @ torch.linalg.solve(known, outer @ y)
    variance = prior - k.T @ torch.linalg.solve(inner, k) + hyper.noise_variance * k.T @ torch.linalg.solve(known, k)
    return mean[0], float(variance)
