"""A virtual step, and a step of a planned rollout, take the nearest action that keeps the declared rates."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from support.models import gaussian_processes
from support.rated import CHANGE, RATED, RatedRail
from support.real_steps import samples_of
from surrogym_sampler.original.rollouts import answering
from surrogym_server.convert import definition_from_spec
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.sampling.rollouts import predict_paths
from surrogym_server.virtual import VirtualSettings, create, in_fastest_form, reset, step

LANES = 4
ASKED = np.random.default_rng(0).uniform(-1, 1, (12, LANES, 1))


@pytest.fixture(scope="module")
def model() -> GaussianProcessModel:
    environment, rng = answering(RatedRail()), np.random.default_rng(1)
    environment.begin(0)
    steps = [environment.act(rng.uniform(-1, 1, 1)) for _ in range(20)]
    return gaussian_processes(definition_from_spec(RATED), samples_of(steps))


def kept(asked: np.ndarray) -> np.ndarray:
    """Actions that follow those asked for as fast as the rate allows, from an action of 0."""
    last, taken = np.zeros(asked.shape[1:]), []
    for action in asked:
        last = np.clip(action, last - CHANGE, last + CHANGE)
        taken.append(last)
    return np.array(taken)


@pytest.mark.parametrize("form", [lambda settings, _: settings, in_fastest_form], ids=["torch", "fastest"])
@pytest.mark.parametrize("variant", ["deterministic", "pathwise", "probabilistic"])
def test_virtual_steps_replace_an_action_that_changes_too_fast_by_the_nearest_allowed_one(model, form, variant):
    settings = form(VirtualSettings(LANES, variant=variant), model)
    lanes, _ = reset(model.definition, settings, create(model.definition, settings, 0))
    free = rated = lanes
    for asked, nearest in zip(ASKED, kept(ASKED), strict=True):
        free, from_asked = step(model, settings, free, asked)
        rated, from_nearest = step(model, settings, rated, nearest)
        np.testing.assert_allclose(from_asked.observation, from_nearest.observation, rtol=1e-5)
        np.testing.assert_allclose(from_asked.reward, from_nearest.reward, rtol=1e-9)
        np.testing.assert_allclose(free.q[:, -1], nearest[:, 0], atol=1e-12)
    assert (kept(ASKED) != ASKED).any(), "the rate changes some of the actions"


def test_a_planned_rollout_has_the_actions_that_the_rate_of_change_allows(model):
    starts = torch.zeros(LANES, len(model.definition.coordinates), dtype=torch.float64)
    asked = torch.from_numpy(ASKED.transpose(1, 0, 2).copy())
    planned = predict_paths(model, starts, asked).u.numpy().transpose(1, 0, 2)
    np.testing.assert_allclose(planned, kept(ASKED), atol=1e-12)
