"""Definitions of known tasks, and models learned from a few of their real steps."""

from __future__ import annotations

import pytest
import torch

from support.real_steps import answer, random_steps
from surrogym_client.original.classic import cartpole, mountain_car_continuous, pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.surrogate.definition import EnvironmentDefinition
from surrogym_server.surrogate.learn import learn
from surrogym_server.surrogate.model import SurrogateModel
from surrogym_server.surrogate.samples import Samples


@pytest.fixture
def pendulum_definition() -> EnvironmentDefinition:
    return definition_from_spec(pendulum())


@pytest.fixture
def cartpole_definition() -> EnvironmentDefinition:
    return definition_from_spec(cartpole())


@pytest.fixture
def mountain_car_definition() -> EnvironmentDefinition:
    return definition_from_spec(mountain_car_continuous())


@pytest.fixture(scope="session")
def pendulum_samples() -> Samples:
    return random_steps(pendulum(), 20, seed=0)


@pytest.fixture(scope="session")
def pendulum_model(pendulum_samples: Samples) -> SurrogateModel:
    return learn(definition_from_spec(pendulum()), pendulum_samples).model


@pytest.fixture(scope="session")
def cartpole_model() -> SurrogateModel:
    return learn(definition_from_spec(cartpole()), random_steps(cartpole(), 12, seed=0)).model


@pytest.fixture(scope="session")
def paper_model(pendulum_samples: Samples) -> SurrogateModel:
    design = pendulum().design.model_copy(update={"preset": "paper"})
    return learn(definition_from_spec(pendulum().model_copy(update={"design": design})), pendulum_samples).model


@pytest.fixture(scope="session")
def half_saturated() -> Samples:
    """Pendulum steps close to the speed limit, where half of them end."""
    rng = torch.Generator().manual_seed(0)
    angle, side, torque = (2 * torch.rand(20, generator=rng, dtype=torch.float64) - 1 for _ in range(3))
    q = torch.stack([torch.pi * angle, 7.6 * side.sign()], -1)
    return answer(pendulum(), q, 2 * torque[:, None])
