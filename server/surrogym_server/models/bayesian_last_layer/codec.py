"""BayesianLastLayerCodec: convert last layers to named arrays and back, and check every shape and number."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.errors import InvalidInput
from surrogym_server.models.bayesian_last_layer.features import Features
from surrogym_server.models.bayesian_last_layer.model import BayesianLastLayerModel
from surrogym_server.models.bayesian_last_layer.regression import Regression
from surrogym_server.models.ensemble.inputs import Inputs
from surrogym_server.models.port import DynamicsModel, ModelCodec, StoredModel
from surrogym_server.models.stored_networks import Header, checked_header, only_label, require_shapes

FORMAT = 1
TRANSITIONS, REWARD, ENDING = "transitions", "reward", "ending"
MAX_MEMBERS, MAX_UNITS, MAX_WAVES = 16, 128, 256
OWN = ("mean", "root", "noise", "parts", "centre", "scale", "left_out")  # arrays of a regression beside its features
Arrays = Mapping[str, Tensor]


class BayesianLastLayerCodec(ModelCodec):
    def encode(self, model: DynamicsModel) -> StoredModel:
        if not isinstance(model, BayesianLastLayerModel):
            raise TypeError(f"expected a model of Bayesian last layers, got {type(model).__name__}")
        tensors = _arrays(TRANSITIONS, model.transitions)
        if model.reward is not None:
            tensors |= _arrays(REWARD, model.reward)
        learned = isinstance(model.ending, Regression)
        if isinstance(model.ending, Regression):
            tensors |= _arrays(ENDING, model.ending)
        label = None if learned else model.ending
        header = Header(FORMAT, model.terminal_reward, model.samples, model.digest, label)
        return StoredModel(header.as_stored(model.definition), tensors)

    def decode(self, definition: EnvironmentDefinition, stored: StoredModel) -> BayesianLastLayerModel:
        return _checked(definition, stored.tensors, checked_header(definition, stored, (FORMAT,)))


def _checked(definition: EnvironmentDefinition, arrays: Arrays, header: Header) -> BayesianLastLayerModel:
    """Build the model of these arrays, after a check of every shape against the environment."""
    inputs = Inputs(definition)
    q = torch.zeros(1, len(definition.coordinates), dtype=torch.float64)
    u = torch.zeros(1, definition.action.size, dtype=torch.float64)
    x, count = inputs.of_transition(q, u), len(definition.outputs) - 1
    transitions = _regression(TRANSITIONS, arrays, x.shape[1], count, quadratic=False)
    reward = None
    if definition.declared_reward is None:
        reward = _regression(REWARD, arrays, inputs.of_reward(q, u, q).shape[1], 1, quadratic=True)
        if reward.members != transitions.members:
            raise InvalidInput(f"{REWARD}: expected {transitions.members} members, got {reward.members}")
    ending: Regression | float | None = None
    if definition.learns_termination:
        learned = f"{ENDING}.mean" in arrays
        ending = (
            _regression(ENDING, arrays, inputs.of_end(q).shape[1], 1, quadratic=False)
            if learned
            else only_label(header.label)
        )
    return BayesianLastLayerModel(
        definition, transitions, reward, ending, header.terminal_reward, header.samples, header.digest
    )


def _arrays(name: str, regression: Regression) -> dict[str, Tensor]:
    own = {f"{name}.{part}": getattr(regression, part) for part in OWN}
    features = {f"{name}.{field.name}": getattr(regression.features, field.name) for field in fields(Features)}
    return {key: tensor.contiguous() for key, tensor in (own | features).items()}


def _regression(name: str, arrays: Arrays, d: int, p: int, *, quadratic: bool) -> Regression:
    """The regression of p outputs of d inputs."""
    features = Features(*(arrays[f"{name}.{field.name}"] for field in fields(Features)))
    own = {part: arrays[f"{name}.{part}"] for part in OWN}
    members, h, r = len(own["mean"]), features.second.shape[-1], features.frequencies.shape[-1]
    if not (1 <= members <= MAX_MEMBERS and 1 <= h <= MAX_UNITS and 0 <= r <= MAX_WAVES):
        raise InvalidInput(
            f"{name}: expected 1 to {MAX_MEMBERS} members of 1 to {MAX_UNITS} units and 0 to {MAX_WAVES} waves, "
            f"got {members} of {h} and {r}"
        )
    k, each = 1 + (2 if quadratic else 1) * d + h + r, members * p
    shapes = {
        "first": (each, d, h),
        "first_bias": (each, 1, h),
        "second": (each, h, h),
        "second_bias": (each, 1, h),
        "frequencies": (each, d, r),
        "phases": (each, 1, r),
        "mean": (members, p, k),
        "root": (members, p, k, k),
        "noise": (members, p),
        "parts": (members, p, 3),
        "centre": (p,),
        "scale": (p,),
        "left_out": (p, 3),
    }
    require_shapes(name, own | vars(features), shapes)
    _require_numbers(name, own)
    return Regression(features=features, **own)


def _require_numbers(name: str, own: Arrays) -> None:
    for part in ("noise", "parts"):
        if bool((own[part] <= 0).any()):
            raise InvalidInput(f"{name}: expected {part} above 0, got {float(own[part].min()):g}")
    for part in ("scale", "left_out"):
        if bool((own[part] < 0).any()):
            raise InvalidInput(f"{name}: expected {part} of at least 0, got {float(own[part].min()):g}")
    if bool((own["left_out"][:, 1:] > 1).any()):
        raise InvalidInput(f"{name}: expected shares of left_out of at most 1, got {float(own['left_out'].max()):g}")
