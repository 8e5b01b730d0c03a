"""Action sequences of policies on a coarse grid: they lead to a far goal, and a design by resets tries them."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from support.models import learn
from support.real_steps import join, roll
from surrogym import Design
from surrogym_sampler.original.classic import mountain_car_continuous
from surrogym_sampler.original.gymnasium import GymnasiumEnvironment
from surrogym_sampler.original.mujoco_tasks import reacher
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.samples import Samples
from surrogym_server.models.port import DynamicsModel
from surrogym_server.planning.sequences import policy_sequences
from surrogym_server.sampling.design import initial_queries
from surrogym_server.sampling.rollouts import Paths, predict_paths, start_points
from surrogym_server.sampling.way_to_end import way_to_end
from surrogym_shared.spec import EnvironmentSpec

LENGTH = 120


@pytest.fixture(scope="module")
def spec() -> EnvironmentSpec:
    """The car between two hills, which can only be reset."""
    return EnvironmentSpec.model_validate({**mountain_car_continuous().model_dump(), "query": "rollout"})


@pytest.fixture(scope="module")
def begun(spec: EnvironmentSpec) -> Samples:
    """The initial rollouts, none of which comes near the goal."""
    queries = initial_queries(definition_from_spec(spec), 200)
    samples = join(*(roll(spec, query.actions, seed) for seed, query in enumerate(queries)))
    assert not bool(samples.terminated.any())
    return samples


@pytest.fixture(scope="module")
def climbing(spec: EnvironmentSpec, begun: Samples) -> DynamicsModel:
    return learn(definition_from_spec(spec), begun).model


@pytest.fixture(scope="module")
def starts(climbing: DynamicsModel) -> torch.Tensor:
    return start_points(climbing.definition, 6, np.random.default_rng(0))


def ends(model: DynamicsModel, starts: torch.Tensor, sequences: np.ndarray) -> list[bool]:
    ended = predict_paths(model, starts, torch.from_numpy(sequences)).ended
    return (ended[:, -1] > 0).tolist()


def test_a_policy_that_seeks_the_end_reaches_the_goal_that_no_sample_has_shown(climbing, starts):
    sequences = policy_sequences(climbing, starts, LENGTH, seek_end=True)
    assert sequences is not None
    assert sequences.shape == (12, LENGTH, 1)
    assert all(ends(climbing, starts, sequences[:6]))
    others = policy_sequences(climbing, starts, LENGTH, seek_end=False)
    assert np.array_equal(sequences[6:], others)
    assert not any(ends(climbing, starts, others)), "the best known return is that of standing still"


def test_a_system_too_large_for_a_grid_or_without_compiled_steps_has_no_policy_sequences(climbing, starts):
    large: Any = SimpleNamespace(definition=definition_from_spec(reacher()))
    assert policy_sequences(large, starts, 5, seek_end=True) is None
    plain: Any = SimpleNamespace(definition=climbing.definition)
    assert policy_sequences(plain, starts, 5, seek_end=True) is None


def test_a_way_to_an_end_fits_into_the_budget_and_is_needed_until_a_sample_has_shown_the_end(climbing, begun):
    way = way_to_end(climbing, begun, LENGTH, np.random.default_rng(0))
    assert way is not None
    assert 60 < way.steps <= LENGTH
    assert way_to_end(climbing, begun, 40, np.random.default_rng(0)) is None, "40 steps are too few to reach the goal"
    seen = replace(begun, terminated=torch.ones_like(begun.terminated))
    assert way_to_end(climbing, seen, LENGTH, np.random.default_rng(0)) is None


def test_an_end_at_the_end_of_a_path_that_can_not_be_predicted_is_not_sought(climbing, begun, monkeypatch):
    def vague(*arguments: Any) -> Paths:
        paths = predict_paths(*arguments)
        return replace(paths, drift=paths.drift + 1)

    monkeypatch.setattr("surrogym_server.sampling.way_to_end.predict_paths", vague)
    assert way_to_end(climbing, begun, LENGTH, np.random.default_rng(0)) is None


def test_an_end_beyond_a_declared_limit_is_not_sought(climbing, begun, monkeypatch):
    def limited(*arguments: Any) -> Paths:
        paths = predict_paths(*arguments)
        return replace(paths, running=paths.running * (paths.q[..., 0] < 0.3).cummin(1).values)

    monkeypatch.setattr("surrogym_server.sampling.way_to_end.predict_paths", limited)
    assert way_to_end(climbing, begun, LENGTH, np.random.default_rng(0)) is None


def test_a_design_by_resets_reaches_a_far_goal_before_it_is_ready(spec):
    """A car that has to swing to and fro for some 70 steps. Seed 0 of the resets."""
    design, machine = Design(spec, budget=400), GymnasiumEnvironment(spec)
    ended = []
    while (query := design.ask()) is not None:
        machine.begin(len(ended))
        steps = []
        for action in query.actions:
            steps.append(machine.act(np.array(action)))
            if steps[-1].terminated:
                break
        design.tell(query, steps)
        ended.append(steps[-1].terminated)
    assert design.phase == "ready"
    assert any(ended)
    assert design.steps < 272, "the fewest steps without policies on a grid, of five seeds"
