"""Conversion of an ensemble of networks to named arrays and back, with a check of every shape and number."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.errors import InvalidInput
from surrogym_server.models.ensemble.inputs import Inputs
from surrogym_server.models.ensemble.model import NetworkEnsembleModel, Noise, Regression
from surrogym_server.models.ensemble.networks import Networks
from surrogym_server.models.port import DynamicsModel, ModelCodec, StoredModel, require_format, require_sums

FORMAT = 2
TRANSITIONS, REWARD, ENDING = "transitions", "reward", "ending"
MAX_MEMBERS, MAX_UNITS = 16, 128
Arrays = Mapping[str, Tensor]


@dataclass(frozen=True)
class Header:
    """Header of a stored ensemble.

    Attributes:
        terminal_reward: reward that is added on a step that ends an episode.
        samples: number of samples to which the model was fitted.
        digest: ``Samples.digest`` of these samples.
        label: 1 if all samples ended an episode, 0 if none did, None if some did or if termination is declared. In
            the header of a file it may be anything, until ``_only_label`` checks it.
    """

    terminal_reward: float
    samples: int
    digest: str
    label: object

    def as_stored(self, definition: EnvironmentDefinition) -> dict[str, Any]:
        return {
            "format": FORMAT,
            "outputs": list(definition.outputs),
            "terminal_reward": self.terminal_reward,
            "samples": self.samples,
            "digest": self.digest,
            "ending": self.label,
        }


class NetworkEnsembleCodec(ModelCodec):
    def encode(self, model: DynamicsModel) -> StoredModel:
        if not isinstance(model, NetworkEnsembleModel):
            raise TypeError(
                f"expected a model of an ensemble of networks, got {type(model).__name__}; use its own family's codec"
            )
        tensors = _regression_arrays(TRANSITIONS, model.transitions)
        if model.reward is not None:
            tensors |= _regression_arrays(REWARD, model.reward)
        networks = isinstance(model.ending, Networks)
        if isinstance(model.ending, Networks):
            tensors |= _arrays(ENDING, model.ending)
        label = None if networks else model.ending
        header = Header(model.terminal_reward, model.samples, model.digest, label)
        return StoredModel(header.as_stored(model.definition), tensors)

    def decode(self, definition: EnvironmentDefinition, stored: StoredModel) -> NetworkEnsembleModel:
        return _checked(definition, stored.tensors, _checked_header(definition, stored))


def _checked(definition: EnvironmentDefinition, arrays: Arrays, header: Header) -> NetworkEnsembleModel:
    """Build the model from stored arrays and header, after a check of every shape against the environment."""
    inputs = Inputs(definition)
    q = torch.zeros(1, len(definition.coordinates), dtype=torch.float64)
    u = torch.zeros(1, definition.action.size, dtype=torch.float64)
    x, count = inputs.of_transition(q, u), len(definition.outputs) - 1
    transitions = _regression(TRANSITIONS, arrays, x.shape[1], count, quadratic=False)
    transitions = replace(transitions, noise=_noise(f"{TRANSITIONS}.noise", arrays, x.shape[1], count))
    reward = None
    if definition.declared_reward is None:
        reward = _regression(REWARD, arrays, inputs.of_reward(q, u, q).shape[1], 1, quadratic=True)
    ending: Networks | float | None = None
    if definition.learns_termination:
        networks = f"{ENDING}.skip" in arrays
        ending = (
            _networks(ENDING, arrays, inputs.of_end(q).shape[1], 1, quadratic=False)
            if networks
            else _only_label(header.label)
        )
    return NetworkEnsembleModel(
        definition, transitions, reward, ending, header.terminal_reward, header.samples, header.digest
    )


def _regression_arrays(name: str, regression: Regression) -> dict[str, Tensor]:
    own = {f"{name}.centre": regression.centre, f"{name}.scale": regression.scale}
    if (noise := regression.noise) is not None:
        own |= {f"{name}.noise.size": noise.size} | _arrays(f"{name}.noise", noise.networks)
    return own | _arrays(name, regression.networks)


def _arrays(name: str, networks: Networks) -> dict[str, Tensor]:
    return {f"{name}.{field.name}": getattr(networks, field.name).contiguous() for field in fields(networks)}


def _regression(name: str, arrays: Arrays, inputs: int, outputs: int, *, quadratic: bool) -> Regression:
    centre, scale = arrays[f"{name}.centre"], arrays[f"{name}.scale"]
    _require_shapes(name, {"centre": centre, "scale": scale}, {"centre": (outputs,), "scale": (outputs,)})
    _require_positive(f"{name}: expected each entry of scale (standard deviations of outputs)", scale)
    return Regression(_networks(name, arrays, inputs, outputs, quadratic=quadratic), centre, scale)


def _noise(name: str, arrays: Arrays, inputs: int, outputs: int) -> Noise:
    size = arrays[f"{name}.size"]
    _require_shapes(name, {"size": size}, {"size": (outputs,)})
    _require_positive(f"{name}: expected each entry of size (standard deviations of noise)", size)
    return Noise(_networks(name, arrays, inputs, outputs, quadratic=False), size)


def _require_positive(what: str, values: Tensor) -> None:
    if bool((values < 0).any()):
        raise InvalidInput(f"model, part {what} to be at least 0, got {float(values.min()):g}; export the model again")


def _networks(name: str, arrays: Arrays, d: int, p: int, *, quadratic: bool) -> Networks:
    networks = Networks(*(arrays[f"{name}.{field.name}"] for field in fields(Networks)))
    k, h = len(networks.skip), networks.last.shape[1]
    if not (2 <= k <= MAX_MEMBERS and 1 <= h <= MAX_UNITS):
        raise InvalidInput(
            f"model, part {name}: expected 2 to {MAX_MEMBERS} networks with 1 to {MAX_UNITS} units in a layer, "
            f"got {k} networks with {h} units; export the model again"
        )
    shapes = {
        "skip": (k, 1 + (2 if quadratic else 1) * d, p),
        "first": (k, d, h),
        "first_bias": (k, 1, h),
        "second": (k, h, h),
        "second_bias": (k, 1, h),
        "last": (k, h, p),
    }
    _require_shapes(name, vars(networks), shapes)
    return networks


def _checked_header(definition: EnvironmentDefinition, stored: StoredModel) -> Header:
    """Return the header of a stored model, after a check of all numbers in the header and in the arrays.

    Raises:
        InvalidInput: the model has another format or other outputs, or numbers that no fit can give.
    """
    header, outputs = stored.header, tuple(stored.header["outputs"])
    require_format(header["format"], FORMAT)
    if outputs != definition.outputs:
        raise InvalidInput(
            f"expected a model with the outputs {definition.outputs}, got one with {outputs}; "
            "load it with the specification that it was learned for"
        )
    terminal_reward, samples = float(header["terminal_reward"]), int(header["samples"])
    require_sums(terminal_reward, samples)
    for name, array in stored.tensors.items():
        if array.dtype != torch.float64 or not bool(torch.isfinite(array).all()):
            came = "NaN or infinity" if array.dtype == torch.float64 else array.dtype
            raise InvalidInput(
                f"expected the model's array {name} as finite numbers in torch.float64, got {came}; "
                "export the model again"
            )
    return Header(terminal_reward, samples, str(header["digest"]), header["ending"])


def _require_shapes(name: str, arrays: Mapping[str, Tensor], shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Raise ``InvalidInput`` unless each of the arrays has the shape that ``shapes`` gives for its name. ``name`` is
    the part of the model that the message names."""
    for part, shape in shapes.items():
        if (got := tuple(arrays[part].shape)) != shape:
            raise InvalidInput(
                f"model, part {name}: expected the array {part} of shape {shape}, got {got}; export the model again"
            )


def _only_label(label: object) -> float:
    """Return the stored label of termination that all samples share: 1 if all ended an episode, 0 if none did. Raises
    ``InvalidInput`` unless it is 0 or 1."""
    if label not in (0.0, 1.0):
        raise InvalidInput(
            "model, part ending: expected 0 or 1, because the model has no network that predicts terminations (1: all "
            f"samples ended an episode, 0: none did), got {str(label)[:80]}; export the model again"
        )
    return float(bool(label))
