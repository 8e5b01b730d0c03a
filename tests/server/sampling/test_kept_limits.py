"""Queries keep the limits of the specification: planned paths end before them, and no point lies within a margin."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from support.exact_models import ExactModel
from support.models import gaussian_processes
from support.plane import drifting, plane
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.sampling.design import initial_queries
from surrogym_server.sampling.rollouts import Aim, plan_rollout, predict_paths, start_points
from surrogym_shared.spec import EnvironmentSpec, Limit, Limits, Term

WALL = Limits(
    keep=(Limit(name="wall", term=Term.linear(x=1.0), low=-0.5, high=0.5, margin=0.1),), fallback=(Term.constant(0.0),)
)
MIDDLE = {name: {"kind": "uniform", "low": -0.05, "high": 0.05} for name in ("x", "y")}


def definition(limits: Limits | None, **changed: Any) -> EnvironmentDefinition:
    fields = {**plane().model_dump(), "start": MIDDLE, "sampling_period": 0.1, "time_limit": 30, **changed}
    return definition_from_spec(EnvironmentSpec.model_validate({**fields, "limits": limits and limits.model_dump()}))


def model(limits: Limits | None, samples: int) -> GaussianProcessModel:
    made = definition(limits, query="rollout", max_rollout=20)
    return gaussian_processes(made, drifting(lambda q, _: q[:, 0], samples))


def farthest(learned: GaussianProcessModel, seed: int) -> float:
    """Largest |x| on the planned path from a reset."""
    aim = Aim(columns=(0, 1, 2), tolerances=(1e-4, 1e-4, 1e-4), longest=20)
    query = plan_rollout(learned, aim, np.random.default_rng(seed))
    start = start_points(learned.definition, 1, np.random.default_rng(seed))
    path = predict_paths(learned, start, torch.tensor([query.actions], dtype=torch.float64))
    return float(path.q_next[..., 0].abs().max())


def allowed_pushes(limits: Limits | None, std: float) -> int:
    """Number of steps of 0.09 to the right, from the middle, that a plan may have if each is known up to ``std``."""
    exact = ExactModel(
        definition(limits, query="rollout", max_rollout=20), lambda q, u: q + u, lambda q, _: q[:, 0], std=std
    )
    pushes = torch.full((1, 20, 1), 0.09, dtype=torch.float64)
    return int(predict_paths(exact, torch.zeros(1, 2, dtype=torch.float64), pushes).running.sum())


def test_planned_rollouts_end_before_a_declared_limit() -> None:
    free, limited = (np.array([farthest(model(limits, 40), seed) for seed in range(4)]) for limits in (None, WALL))
    assert free.max() > 0.5
    assert limited.max() < 0.5


def test_a_planned_rollout_ends_where_the_safety_fallback_would_act_or_sooner_if_uncertain() -> None:
    """Four steps lead to 0.36, from where another one would reach the margin, which begins at 0.4."""
    assert allowed_pushes(WALL, 0.0) == 4
    assert allowed_pushes(None, 0.0) == 20
    assert allowed_pushes(WALL, 0.1) == 2, "the range of x at 0.18, twice 0.1 at 99 %, contains the limit at 0.5"


@pytest.mark.parametrize("limits", [None, WALL])
def test_initial_queries_of_a_settable_environment_avoid_the_margins_of_declared_limits(limits: Limits | None) -> None:
    queries = initial_queries(definition(limits), 40)
    farthest_state = max(abs(query.coordinates[0]) for query in queries)
    assert (farthest_state <= 0.4) == (limits is not None)
