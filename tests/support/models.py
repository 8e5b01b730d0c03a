"""Models learned as a design learns them."""

from __future__ import annotations

import json
from typing import Any

from safetensors.torch import load

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.samples import Samples
from surrogym_server.models.files import to_bytes, with_checksum
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.models.port import DynamicsModel, Learned, Warm
from surrogym_server.models.registry import learner_of


def learn(definition: EnvironmentDefinition, samples: Samples, warm: Warm | None = None) -> Learned:
    """By the family that the definition names."""
    return learner_of(definition.learning.model).learn(definition, samples, warm)


def gaussian_processes(definition: EnvironmentDefinition, samples: Samples) -> GaussianProcessModel:
    """A model of the default family."""
    model = learn(definition, samples).model
    assert isinstance(model, GaussianProcessModel)
    return model


def header_of(data: bytes) -> dict[str, Any]:
    """The header of a model's file, without the checksum."""
    header: dict[str, Any] = json.loads(
        json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])["__metadata__"]["surrogym"]
    )
    del header["checksum"]
    return header


def with_header(model: DynamicsModel, **header: object) -> bytes:
    """The file of a model, with other entries in its header, and a checksum of them."""
    data = to_bytes(model)
    return with_checksum(header_of(data) | header, load(data))
