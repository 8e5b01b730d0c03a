"""Conversion of a model of Gaussian processes to a header and named arrays, and back, without repeated computations."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.errors import InvalidInput
from surrogym_server.models.gaussian_process.codec.outputs import (
    output_header,
    output_tensors,
    read_output,
    require_output,
)
from surrogym_server.models.gaussian_process.codec.regions import (
    read_jumps,
    read_region,
    region_header,
    region_tensors,
    require_region,
)
from surrogym_server.models.gaussian_process.model import GaussianProcessModel
from surrogym_server.models.gaussian_process.prediction.regions import TERMINATION
from surrogym_server.models.port import DynamicsModel, ModelCodec, StoredModel, require_format, require_sums

FORMAT = 8
JUMP = "jump"  # in a stored model, names of arrays that belong to a jump of the reward begin with this
PRIOR = "prior."  # in a stored model, names of arrays that belong to its prior model begin with this


class GaussianProcessCodec(ModelCodec):
    """Codec of models in the current format. Models in any other format are refused."""

    def encode(self, model: DynamicsModel) -> StoredModel:
        if not isinstance(model, GaussianProcessModel):
            raise TypeError(
                f"expected a model of Gaussian processes, got {type(model).__name__}; use its own family's codec"
            )
        return StoredModel(_header(model), _tensors(model))

    def decode(self, definition: EnvironmentDefinition, stored: StoredModel) -> GaussianProcessModel:
        model = _read(definition, stored)
        _require_consistent(model)
        for output in model.outputs:
            require_output(definition, output)
        for region in (*(jump.region for jump in model.jumps), *([] if model.ending is None else [model.ending])):
            require_region(region)
        if not all(math.isfinite(jump.size) for jump in model.jumps):
            sizes = [jump.size for jump in model.jumps][:4]
            raise InvalidInput(f"expected finite sizes of the jumps of the reward, got {sizes}; export the model again")
        return model


def _tensors(model: GaussianProcessModel) -> dict[str, Tensor]:
    tensors: dict[str, Tensor] = {} if model.ending is None else region_tensors(model.ending, TERMINATION)
    for index, jump in enumerate(model.jumps):
        tensors |= region_tensors(jump.region, f"{JUMP}.{index}")
    for index, output in enumerate(model.outputs):
        tensors |= output_tensors(output, str(index))
    if model.prior is not None:
        tensors |= {PRIOR + name: tensor for name, tensor in _tensors(model.prior).items()}
    return tensors


def _header(model: GaussianProcessModel) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "outputs": [output_header(output) for output in model.outputs],
        "terminal_reward": model.terminal_reward,
        "samples": model.samples,
        "digest": model.digest,
        "jumps": [[jump.size, region_header(jump.region)] for jump in model.jumps],
        "termination": None if model.ending is None else region_header(model.ending),
        "prior": None if model.prior is None else _header(model.prior),
    }


def _read(definition: EnvironmentDefinition, stored: StoredModel) -> GaussianProcessModel:
    header, tensors = stored.header, stored.tensors
    require_format(header["format"], FORMAT)
    terminal_reward = float(header["terminal_reward"])
    outputs = tuple(read_output(definition, entry, tensors, str(i)) for i, entry in enumerate(header["outputs"]))
    samples, digest = int(header["samples"]), str(header["digest"])
    ending = read_region(definition, header["termination"], tensors, TERMINATION)
    jumps = read_jumps(definition, header["jumps"], tensors, JUMP)
    names = tuple(output.name for output in outputs)
    if names != definition.outputs:
        raise InvalidInput(
            f"expected a model with the outputs {definition.outputs}, got one with {names}; "
            "load it with the specification that it was learned for"
        )
    prior = _read_prior(definition, header["prior"], tensors)
    return GaussianProcessModel(
        definition, outputs[:-1], outputs[-1], terminal_reward, samples, digest, ending, jumps, prior
    )


def _read_prior(
    definition: EnvironmentDefinition, header: dict[str, Any] | None, tensors: Mapping[str, Tensor]
) -> GaussianProcessModel | None:
    if header is None:
        return None
    own = {name.removeprefix(PRIOR): tensor for name, tensor in tensors.items() if name.startswith(PRIOR)}
    return GaussianProcessCodec().decode(definition, StoredModel(header, own))


def _require_consistent(model: GaussianProcessModel) -> None:
    """Raise ``InvalidInput`` if parts of a model contradict each other or the environment's definition."""
    definition, reward = model.definition, model.reward
    if model.prior is None and any(output.size_with_prior is not None for output in model.outputs):
        raise InvalidInput(
            "expected a model that contains a prior model, because one of its outputs adds to the prior's predictions, "
            "got a model with no prior; export the model again"
        )
    require_sums(model.terminal_reward, model.samples)
    if any(output.feature_map.after for output in model.transitions):
        raise InvalidInput(
            "expected a model that predicts the next state from the state before the step, got a model with an output "
            "that reads the state after the step; export the model again"
        )
    if (model.ending is not None) != definition.learns_termination:
        learned, got = ("learned" if x else "declared" for x in (definition.learns_termination, model.ending))
        raise InvalidInput(
            f"expected a model of an environment whose termination is {learned}, got one whose termination is {got}; "
            "load it with the specification that it was learned for"
        )
    declared = definition.declared_reward
    if declared is not None and (reward.posterior, reward.centre, reward.feature_map.after) != (
        None,
        0.0,
        declared.after,
    ):
        raise InvalidInput(
            "the model has a learned reward, but the environment's reward is declared; learn the model again"
        )
