"""Models learned from a few real steps of known tasks."""

from __future__ import annotations

import pytest

from support.models import learn
from support.real_steps import random_steps
from surrogym_sampler.original.classic import cartpole, pendulum
from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.samples import Samples
from surrogym_server.models.gaussian_process.model import GaussianProcessModel


@pytest.fixture(scope="session")
def pendulum_model(pendulum_samples: Samples) -> GaussianProcessModel:
    return learn(definition_from_spec(pendulum()), pendulum_samples).model


@pytest.fixture(scope="session")
def cartpole_model() -> GaussianProcessModel:
    return learn(definition_from_spec(cartpole()), random_steps(cartpole(), 12, seed=0)).model


@pytest.fixture(scope="session")
def paper_model(pendulum_samples: Samples) -> GaussianProcessModel:
    design = pendulum().design.model_copy(update={"preset": "paper"})
    return learn(definition_from_spec(pendulum().model_copy(update={"design": design})), pendulum_samples).model
