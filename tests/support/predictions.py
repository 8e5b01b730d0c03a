"""Predictions of a model are those of its processes, and those of its compiled steps."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from support.steps_in_c import check_in_c
from surrogym_server.models.abilities import PredictedSteps
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.models.gaussian_process.prediction.lookahead import process_inputs

WAYS = ("mean", "particles", "functions", "in C")


def check_processes(model: GaussianProcessModel, points: tuple[Tensor, Tensor]) -> None:
    """At points q (m, C), u (m, F) the transition has the means and deviations of the outputs' processes."""
    moved = model.transition(*points, stds=True)
    assert moved.std is not None
    for column, output in enumerate(model.transitions):
        x = process_inputs(model.definition, output, PredictedSteps(*points, points[0]))
        mean, std = output.mean_and_std(x)
        torch.testing.assert_close(moved.q_next[:, column] - points[0][:, column], mean, rtol=1e-6, atol=1e-9)
        torch.testing.assert_close(moved.std[:, column], std, rtol=1e-4, atol=1e-7)


def check_compiled(model: GaussianProcessModel, points: tuple[Tensor, Tensor], how: str) -> None:
    """Compiled steps from q (m, C) under u (m, F) are the model's own, in one of ``WAYS``."""
    if how == "in C":
        check_in_c(model, points, loose=True)
        return
    compiled = model.compiled()
    if compiled is None:
        pytest.skip("steps can't be compiled here")
    generator, (rows, size) = torch.Generator().manual_seed(0), points[0].shape
    given: dict[str, Any] = {}
    if how == "particles":
        given = {n: torch.randn(rows, size, generator=generator, dtype=torch.float64) for n in ("noise", "process")}
    if how == "functions":
        given = {"paths": model.draw(torch.randn(rows, model.path_size, generator=generator, dtype=torch.float64))}
        ours = model.transition_along(given["paths"], *points, stds=True)
    else:
        ours = model.transition(*points, stds=True, **given)
    arrays = {name: given[name].numpy() if name in given else None for name in ("noise", "process", "paths")}
    theirs = compiled(*(p.numpy() for p in points), **arrays, stds=True, reward_std=False)
    torch.testing.assert_close(torch.from_numpy(theirs.q_next), ours.q_next, rtol=1e-7, atol=1e-8)
    torch.testing.assert_close(torch.from_numpy(theirs.reward), ours.reward, rtol=1e-7, atol=1e-8)
    torch.testing.assert_close(torch.from_numpy(theirs.std[:, :size]), ours.std, rtol=1e-4, atol=1e-7)
