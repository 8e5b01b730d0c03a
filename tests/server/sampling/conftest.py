"""A Pendulum learned from few real steps, and the shape of a round."""

from __future__ import annotations

import pytest
import torch

from support.models import learn
from support.real_steps import answer, arrays, random_steps
from support.remembered import learn_once
from surrogym_sampler.original.classic import pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.samples import Samples
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.sampling.design import initial_queries


@pytest.fixture(autouse=True)
def _equal_fits_are_made_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("surrogym_server.sampling.design.learn", learn_once)


@pytest.fixture(scope="session")
def definition() -> EnvironmentDefinition:
    return definition_from_spec(pendulum())


@pytest.fixture(scope="session")
def few(definition: EnvironmentDefinition) -> Samples:
    """The answers to the initial design."""
    return answer(pendulum(), *arrays(initial_queries(definition, 20)))


@pytest.fixture(scope="session")
def model(definition: EnvironmentDefinition, few: Samples) -> GaussianProcessModel:
    return learn(definition, few).model


@pytest.fixture(scope="session")
def unseen() -> Samples:
    return random_steps(pendulum(), 200, seed=99)


@pytest.fixture
def points() -> tuple[torch.Tensor, torch.Tensor]:
    """Coordinates and actions of candidates."""
    generator = torch.Generator().manual_seed(4)
    p = 2 * torch.rand(60, 3, generator=generator, dtype=torch.float64) - 1
    return torch.stack([torch.pi * p[:, 0], 8 * p[:, 1]], -1), 2 * p[:, 2:]
