"""Compiled outputs are their posteriors: shared, permuted inputs, scaled, constant, in blocks, by products or not."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from surrogym_server.gp import Hyperparameters, Output, Serving, condition, serving
from surrogym_server.tensors import in_blocks, to_device

INPUTS = ((0, 1, 2), (3, 1, 0), (2, 4, 3))
WIDTH, COLUMNS, CONSTANT = 5, 5, 4


@pytest.fixture
def outputs(rng, hyper) -> list[Output]:
    """Three processes over 12, 15 and 18 points of three of five inputs each, in columns 3, 0, 1; column 4 is constant,
    and column 2 empty."""
    made = [Output(CONSTANT, None, (), centre=2.5)]
    for place, (inputs, column) in enumerate(zip(INPUTS, (3, 0, 1), strict=True)):
        x = torch.from_numpy(rng.normal(size=(12 + 3 * place, 3)))
        posterior = condition(hyper, x, torch.sin(x[:, 0]) + 0.3 * x[:, place])
        made.append(Output(column, posterior, inputs, centre=place - 1.0, scale=0.5 + place))
    return made


@pytest.fixture
def at(rng) -> torch.Tensor:
    return torch.from_numpy(rng.normal(size=(23, WIDTH)))


@pytest.mark.parametrize("tolerance", [0.0, 1.0], ids=["differences", "products"])
def test_each_served_output_equals_the_posterior_of_its_own_process(outputs, at, monkeypatch, device, tolerance):
    monkeypatch.setattr(serving, "MEAN_TOLERANCE", tolerance)
    monkeypatch.setattr(serving, "VARIANCE_TOLERANCE", tolerance)
    compiled = Serving.of(to_device(tuple(outputs), device), COLUMNS, WIDTH, device)
    mean, std = (values.cpu() for values in compiled.mean_and_std(at.to(device), range(COLUMNS)))
    torch.testing.assert_close(compiled.mean(at.to(device)).cpu(), mean, rtol=0, atol=0)
    assert (mean[:, 2] == 0).all()
    assert (mean[:, CONSTANT] == 2.5).all()
    assert (std[:, [2, CONSTANT]] == 0).all()
    for output in outputs[1:]:
        expected, variance = output.posterior.mean_and_variance(at[:, list(output.inputs)])
        torch.testing.assert_close(
            mean[:, output.column], output.centre + output.scale * expected, rtol=1e-9, atol=1e-9
        )
        torch.testing.assert_close(std[:, output.column], output.scale * variance.sqrt(), rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("tolerance", [0.0, 1e9], ids=["differences", "products"])
def test_served_values_of_sampled_functions_equal_those_of_their_own_process(outputs, at, monkeypatch, rng, tolerance):
    monkeypatch.setattr(serving, "FUNCTION_TOLERANCE", tolerance)
    compiled = Serving.of(outputs, COLUMNS, WIDTH)
    samplers = [process.pathwise for process in compiled.processes.values()]
    noise = [torch.from_numpy(rng.standard_normal((len(at), one.size))) for one in samplers]
    weights = [one.draw(own) for one, own in zip(samplers, noise, strict=True)]
    paths = torch.cat([at.new_full((len(at), 2), torch.nan), *weights], 1)  # the first two belong to others
    value, std = compiled.mean_and_std(at, [1], paths, 2)
    torch.testing.assert_close(std, compiled.mean_and_std(at, [1])[1], rtol=1e-7, atol=1e-9)
    for output, one, own in zip(outputs[1:], samplers, weights, strict=True):
        residual = output.scale * one.residual(at[:, list(output.inputs)], own)
        torch.testing.assert_close(
            value[:, output.column] - compiled.mean(at)[:, output.column], residual, rtol=1e-7, atol=1e-7
        )


def test_served_standard_deviations_that_were_not_requested_are_zero(outputs, at):
    compiled = Serving.of(outputs, COLUMNS, WIDTH)
    _, some = compiled.mean_and_std(at, [1])
    _, every = compiled.mean_and_std(at, range(COLUMNS))
    assert torch.equal(some[:, 1], every[:, 1])
    assert (some[:, [0, 2, 3, 4]] == 0).all()


def test_served_predictions_do_not_depend_on_the_block_size(outputs, at, monkeypatch):
    compiled = Serving.of(outputs, COLUMNS, WIDTH)
    whole = compiled.mean_and_std(at, range(COLUMNS))
    monkeypatch.setattr(serving, "BLOCK", 1)
    monkeypatch.setattr(serving, "MIN_ROWS", 5)
    assert compiled.rows == 5
    for ours, theirs in zip(compiled.mean_and_std(at, range(COLUMNS)), whole, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-9)


def test_a_served_block_has_fewer_rows_if_the_processes_have_more_points(outputs):
    few, many = Serving.of(outputs[:2], COLUMNS, WIDTH), Serving.of(outputs, COLUMNS, WIDTH)
    assert few.rows * 12 <= serving.BLOCK
    assert many.rows < few.rows


def test_a_served_block_is_larger_on_a_gpu_which_idles_between_small_ones(outputs):
    """A tensor of the device "meta" stands for one on a GPU: it has a size, and nothing is computed."""
    here = Serving.of(outputs, COLUMNS, WIDTH)
    there = replace(here, exponents=here.exponents.to("meta"))
    assert there.rows == serving.GPU_BLOCK // here.exponents.shape[1] > 100 * here.rows


def test_a_function_applied_in_blocks_of_rows_gives_the_joined_results():
    sizes = []

    def function(a: torch.Tensor, b: torch.Tensor | None) -> tuple[torch.Tensor, torch.Tensor]:
        assert b is None
        sizes.append(len(a))
        return a + 1, a[:, None].expand(-1, 2)

    one, two = in_blocks(4, function, torch.arange(10), None)
    assert sizes == [4, 4, 2]
    assert one.tolist() == list(range(1, 11))
    assert two.shape == (10, 2)
    assert in_blocks(4, function, torch.arange(0), None)[0].shape == (0,)


@pytest.mark.parametrize("length", [0.05, 0.5, 5.0])
def test_the_error_bound_of_matrix_product_distances_holds(rng, length):
    """Exponents by products err by less than the bound in every point's covariance, out to twice the reach."""
    hyper = Hyperparameters(length * torch.tensor([1.0, 2.0, 0.7], dtype=torch.float64), 1.0, 0.0, 0.0, 1e-4)
    x = torch.from_numpy(rng.normal(size=(60, 3)))
    posterior = condition(hyper, x, x[:, 0])
    unit = replace(posterior, weights=torch.ones_like(posterior.weights))
    bound, _ = serving._error_bounds(unit)
    compiled = Serving.of([Output(0, unit, (0, 1, 2))], 1, 3)
    at = torch.cat([x, x + 1e-3, torch.from_numpy(rng.normal(size=(100, 3)))])
    wide = [t.numpy().astype(np.longdouble) for t in (at / hyper.lengthscale, x / hyper.lengthscale)]
    exact = np.exp(-0.5 * ((wide[0][:, None] - wide[1][None]) ** 2).sum(-1)).sum(1)
    error = np.abs(compiled.mean(at)[:, 0].numpy() - exact).max()
    assert 0 < error <= bound


def test_distances_are_computed_by_differences_if_matrix_products_are_too_inaccurate(rng):
    x = torch.from_numpy(rng.normal(size=(40, 2)))
    x = torch.cat([x, x + 1e-7])
    hyper = Hyperparameters(torch.tensor([0.01, 0.01], dtype=torch.float64), 1.0, 0.0, 0.0, 1e-12)
    careful = Serving.of([Output(0, condition(hyper, x, torch.sin(3e7 * x[:, 0])), (0, 1))], 1, 2).processes[0]
    assert careful.mean_by_differences
    assert careful.variance_by_differences
    easy = replace(hyper, lengthscale=100 * hyper.lengthscale, noise_variance=1e-2)
    plain = Serving.of([Output(0, condition(easy, x, x[:, 0]), (0, 1))], 1, 2).processes[0]
    assert not plain.mean_by_differences
    assert not plain.variance_by_differences
