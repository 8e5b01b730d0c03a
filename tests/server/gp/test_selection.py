"""Inputs that a process leaves out by evidence."""

from __future__ import annotations

import torch
from torch import Tensor

from surrogym_server.gp import FitOptions, Reflection, fit, select_inputs
from surrogym_server.gp.search import Evidence

OPTIONS, ODDS = FitOptions(), -1.0


def points(count: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Five inputs, of which the values read the first and the fourth."""
    x = 3.4 * torch.rand(count, 5, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 1.7
    y = torch.sin(1.5 * x[:, 0]) + 0.5 * x[:, 3]
    return x, y / y.std()


def selected(x: Tensor, y: Tensor, may: Tensor, mirror: Reflection | None = None) -> tuple[list[int], float, float]:
    """What is kept, and the log evidence with it and with all inputs."""
    fitted = fit(x, y, OPTIONS, reflection=mirror)
    found = select_inputs(fitted.posterior, OPTIONS, may, ODDS)
    assert found.hyper.lengthscale.shape == (int(found.mask.sum()),)
    return found.mask.nonzero()[:, 0].tolist(), found.score, fitted.score


def test_input_selection_drops_irrelevant_inputs():
    kept, score, before = selected(*points(25), torch.ones(5, dtype=torch.bool))
    assert kept == [0, 3]
    assert score > before + 3


def test_the_score_of_an_input_selection_equals_that_of_a_process_with_only_those_inputs():
    x, y = points(25)
    found = select_inputs(fit(x, y, OPTIONS).posterior, OPTIONS, torch.ones(5, dtype=torch.bool), ODDS)
    cost, _ = Evidence(x[:, found.mask], y, OPTIONS, None)(found.theta)
    assert abs(found.score + cost) < 1e-6


def test_input_selection_keeps_protected_inputs():
    may = torch.tensor([True, False, True, True, True])
    assert selected(*points(25), may)[0] == [0, 1, 3]


def test_input_selection_keeps_all_inputs_if_all_are_relevant():
    x, y = points(25)
    y = y + x[:, 1] * x[:, 2] + torch.cos(x[:, 4])
    fitted = fit(x, y, OPTIONS)
    found = select_inputs(fitted.posterior, OPTIONS, torch.ones(5, dtype=torch.bool), ODDS)
    assert bool(found.mask.all())
    assert abs(found.gain) < 0.1
    torch.testing.assert_close(found.hyper.lengthscale, fitted.posterior.hyper.lengthscale, rtol=0.05, atol=0)


def test_input_selection_of_an_odd_function_keeps_an_input_that_changes_sign():
    x, y = points(12)
    mirror = Reflection(torch.tensor([1.0, -1.0, 1.0, 1.0, 1.0], dtype=torch.float64), -1)
    assert 1 in selected(x, y, torch.ones(5, dtype=torch.bool), mirror)[0]


def test_input_selection_keeps_at_least_one_input():
    x, _ = points(12)
    mirror = Reflection(torch.ones(5, dtype=torch.float64), 1)
    for reflection in (None, mirror):
        assert selected(x, x[:, 2].square(), torch.ones(5, dtype=torch.bool), reflection)[0] == [2]
