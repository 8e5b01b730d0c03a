"""What the files of all families of networks have in common: the header, and checks of arrays and of an only label."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.errors import InvalidInput
from surrogym_server.models.port import StoredModel


@dataclass(frozen=True)
class Header:
    """Header of a file.

    Attributes:
        format: of the arrays.
        terminal_reward: added on a step that ends an episode.
        samples, digest: of what the model has learned from.
        label: the only label of an ending, if there is one; not checked.
    """

    format: int
    terminal_reward: float
    samples: int
    digest: str
    label: object

    def as_stored(self, definition: EnvironmentDefinition) -> dict[str, Any]:
        return {
            "format": self.format,
            "outputs": list(definition.outputs),
            "terminal_reward": self.terminal_reward,
            "samples": self.samples,
            "digest": self.digest,
            "ending": self.label,
        }


def checked_header(definition: EnvironmentDefinition, stored: StoredModel, formats: tuple[int, ...]) -> Header:
    """The header of a model of one of some formats, the newest last, after a check of all numbers.

    Raises:
        InvalidInput: another format or other outputs, or numbers that no fit gives.
    """
    header, outputs = stored.header, tuple(stored.header["outputs"])
    if header["format"] not in formats or outputs != definition.outputs:
        raise InvalidInput(
            f"expected a model of format {formats[-1]} with outputs {definition.outputs}, "
            f"got format {header['format']!r} with {outputs}"
        )
    terminal_reward, samples = float(header["terminal_reward"]), int(header["samples"])
    if not math.isfinite(terminal_reward) or samples < 1:
        raise InvalidInput(f"expected a finite terminal reward and samples, got {terminal_reward} and {samples}")
    for name, array in stored.tensors.items():
        if array.dtype != torch.float64 or not bool(torch.isfinite(array).all()):
            raise InvalidInput(f"expected finite numbers of torch.float64 as {name}, got {array.dtype}")
    return Header(header["format"], terminal_reward, samples, str(header["digest"]), header["ending"])


def require_shapes(name: str, arrays: Mapping[str, Tensor], shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Raise ``InvalidInput`` if an array of a part of a model has another shape."""
    for part, shape in shapes.items():
        if (got := tuple(arrays[part].shape)) != shape:
            raise InvalidInput(f"{name}: expected {part} of shape {shape}, got {got}")


def only_label(label: object) -> float:
    """The label of an ending whose samples have no other one. Raises ``InvalidInput`` if it is neither 0 nor 1."""
    if label not in (0.0, 1.0):
        raise InvalidInput(f"expected the only label of an ending to be 0 or 1, got {str(label)[:80]}")
    return float(bool(label))
