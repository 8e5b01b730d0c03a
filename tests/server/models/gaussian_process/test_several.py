"""Functions that lanes share have uncertain hyperparameters where samples are few; nothing else changes."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from support.models import gaussian_processes
from support.plane import drifting, plane
from support.real_steps import random_steps
from surrogym_sampler.original.classic import pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.samples import Samples
from surrogym_server.models.abilities import CompiledSteps, FunctionDraws
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.models.gaussian_process.prediction.several import (
    MODELS,
    MOST_POINTS,
    NEGLIGIBLE,
    FunctionsOfSeveral,
)
from surrogym_server.models.gaussian_process.prediction.warp import PEAK_NOISE

ROWS = 24


@pytest.fixture(scope="module")
def model() -> GaussianProcessModel:
    return gaussian_processes(definition_from_spec(pendulum()), random_steps(pendulum(), 6, seed=3))


@pytest.fixture(scope="module")
def points() -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(0)
    return torch.from_numpy(rng.uniform(-3, 3, (ROWS, 2))), torch.from_numpy(rng.uniform(-2, 2, (ROWS, 1)))


def drawn(draws: FunctionDraws, count: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return draws.draw(torch.randn(count, draws.path_size, generator=generator, dtype=torch.float64))


def test_each_batch_row_steps_with_the_hyperparameter_sample_drawn_for_it(model, points):
    several = model.uncertain_functions
    assert isinstance(several, FunctionsOfSeveral)
    paths = drawn(several, ROWS)
    moved = several.transition_along(paths, *points, stds=True, reward_std=True)
    assert len(paths[:, 0].unique()) > 2
    for row in range(0, ROWS, 5):
        at = slice(row, row + 1)
        one = several.models[int(paths[row, 0])].transition_along(
            paths[at, 1:], points[0][at], points[1][at], stds=True, reward_std=True
        )
        for name in ("q_next", "reward", "std", "reward_std"):
            torch.testing.assert_close(getattr(moved, name)[at], getattr(one, name), rtol=1e-9, atol=1e-9)


def test_compiled_steps_of_functions_drawn_from_the_posterior_equal_uncompiled_ones(model, points):
    several = model.uncertain_functions
    assert isinstance(several, CompiledSteps)
    steps = several.compiled()
    if steps is None:
        pytest.skip("steps can't be compiled here")
    paths = drawn(several, ROWS)
    arrays = [tensor.numpy() for tensor in points]
    moved = steps(*arrays, noise=None, process=None, paths=paths.numpy(), stds=False, reward_std=False)
    reference = several.transition_along(paths, *points)
    np.testing.assert_allclose(moved.q_next, reference.q_next, atol=1e-8)
    np.testing.assert_allclose(moved.reward, reference.reward, atol=1e-8)


def test_functions_with_sampled_hyperparameters_vary_more_than_with_optimal_ones(model, points):
    """Six samples of a pendulum: the deviation over functions, as a median over points."""
    spreads = []
    for draws in (model, model.uncertain_functions):
        paths = drawn(draws, 256)
        rewards = [
            draws.transition_along(paths, *(t[i : i + 1].expand(256, -1) for t in points)).reward for i in range(8)
        ]
        spreads.append(float(torch.stack(rewards).std(1).median()))
    assert spreads[1] > 1.2 * spreads[0]


def test_with_many_samples_functions_use_only_the_optimal_hyperparameters():
    samples = random_steps(pendulum(), 2 * MOST_POINTS, seed=0)
    known = gaussian_processes(definition_from_spec(pendulum()), samples)
    assert known.uncertain_functions is known


def test_a_model_samples_its_hyperparameters_once(model):
    several = model.uncertain_functions
    assert several is model.uncertain_functions
    assert isinstance(several, FunctionsOfSeveral)
    assert len(several.models) == MODELS


def test_functions_drawn_from_a_log_reward_model_keep_its_small_noise():
    """A hundred times that noise is several per cent of a reward whose logarithm spreads over hundreds."""

    def bump(q: torch.Tensor, _: torch.Tensor) -> torch.Tensor:
        return (-0.5 * (q / 0.04).square().sum(-1)).exp()

    hidden = gaussian_processes(definition_from_spec(plane()), drifting(bump, 12))
    assert hidden.reward.posterior.hyper.noise_variance < 2 * PEAK_NOISE
    several = hidden.uncertain_functions
    assert isinstance(several, FunctionsOfSeveral)
    assert max(one.reward.posterior.hyper.noise_variance for one in several.models) < 10 * PEAK_NOISE


def shaken(repeats: int) -> Samples:
    """Steps of the plane whose x is shaken by noise. The first of them are repeated."""
    steps = drifting(lambda q, _: -q.square().sum(-1), 24)
    rows = torch.cat([torch.arange(24), torch.arange(repeats)])
    noise = torch.randn(len(rows), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    q_next = steps.q_next[rows] + 0.02 * torch.stack([noise, 0 * noise], -1)
    return Samples(steps.q[rows], steps.u[rows], q_next, steps.reward[rows], steps.terminated[rows])


@pytest.mark.parametrize(
    ("spec", "repeats", "kept"),
    [
        pytest.param(plane(), 0, False, id="no step was repeated"),
        pytest.param(plane(), 4, True, id="repeated steps show it"),
        pytest.param(plane().model_copy(update={"query": "rollout", "max_rollout": 20}), 0, True, id="none can be"),
    ],
)
def test_drawn_functions_have_noise_only_if_repeated_steps_show_it(spec, repeats, kept):
    known = gaussian_processes(definition_from_spec(spec), shaken(repeats))
    assert known.transitions[0].posterior.hyper.noise_variance > NEGLIGIBLE
    several = known.uncertain_functions
    assert isinstance(several, FunctionsOfSeveral)
    noises = [one.transitions[0].posterior.hyper.noise_variance for one in several.models]
    assert min(noises) > NEGLIGIBLE if kept else max(noises) <= NEGLIGIBLE
