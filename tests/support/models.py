"""Models learned as a design learns them."""

from __future__ import annotations

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.samples import Samples
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.models.port import Learned, Warm
from surrogym_server.models.registry import learner_of


def learn(definition: EnvironmentDefinition, samples: Samples, warm: Warm | None = None) -> Learned:
    """By the family that the definition names."""
    return learner_of(definition.learning.model).learn(definition, samples, warm)


def gaussian_processes(definition: EnvironmentDefinition, samples: Samples) -> GaussianProcessModel:
    """A model of the default family."""
    model = learn(definition, samples).model
    assert isinstance(model, GaussianProcessModel)
    return model
