"""A model as one file: safetensors with a JSON header that names its family. Nothing is pickled or evaluated."""

from __future__ import annotations

import hashlib
import json
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.errors import InvalidInput
from surrogym_server.models.port import DynamicsModel, StoredModel
from surrogym_server.models.registry import learner_of

METADATA = "surrogym"
FAMILY, CHECKSUM = "family", "checksum"
AGAIN = "export it again"
SHOWN = 80  # largest number of characters of a name from a file
MALFORMED = (SafetensorError, ValueError, LookupError, TypeError, AttributeError, RecursionError, OverflowError)


def to_bytes(model: DynamicsModel) -> bytes:
    """Write the whole model, serving arrays included."""
    family = model.definition.learning.model
    data = learner_of(family).codec.encode(model)
    return with_checksum({FAMILY: family.name, **data.header}, data.tensors)


def with_checksum(header: dict[str, Any], tensors: dict[str, Tensor]) -> bytes:
    """Write a header that JSON can represent, and named tensors, with the checksum of both."""
    return save(tensors, {METADATA: json.dumps(header | {CHECKSUM: _checksum(header, tensors)})})


def from_bytes(definition: EnvironmentDefinition, data: bytes) -> DynamicsModel:
    """Read the model that ``to_bytes`` wrote.

    Raises:
        InvalidInput: not such a file, or a damaged one, or one of another family than the definition's, or of an
            environment with other outputs.
    """
    header, tensors = _content(data)
    try:
        return _model(definition, header, tensors)
    except KeyError as error:
        raise InvalidInput(f"expected a model with the entry {str(error)[:SHOWN]}, got one without: {AGAIN}") from error
    except MALFORMED as error:
        raise InvalidInput(f"expected a model whose entries fit together, got others: {AGAIN}") from error


def _content(data: bytes) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Return header and tensors of a file. Raises ``InvalidInput`` unless they are as they were written."""
    length = int.from_bytes(data[:8], "little")
    try:
        header = json.loads(json.loads(data[8 : 8 + length])["__metadata__"][METADATA])
        tensors = load(data)
        written = header.pop(CHECKSUM)
    except MALFORMED as error:
        raise InvalidInput(
            f"expected a Surrogym model in safetensors form with a checksum, got {len(data)} bytes of another "
            f"form: {AGAIN}"
        ) from error
    if written != _checksum(header, tensors):
        raise InvalidInput(f"the model is damaged: its checksum differs from the one that it was written with; {AGAIN}")
    return header, tensors


def _model(definition: EnvironmentDefinition, header: dict[str, Any], tensors: dict[str, Tensor]) -> DynamicsModel:
    expected, got = definition.learning.model, header.pop(FAMILY)
    if got != expected.name:
        raise InvalidInput(
            f"expected a model of the family {expected.name!r}, as the specification says, got one of {str(got)[:80]!r}"
        )
    return learner_of(expected).codec.decode(definition, StoredModel(header, tensors))


def _checksum(header: dict[str, Any], tensors: dict[str, Tensor]) -> str:
    """SHA-256 of the content, independent of the order of the arrays in the file."""
    total = hashlib.sha256(json.dumps(header).encode())
    for name in sorted(tensors):
        total.update(f"{name} {tensors[name].dtype} {list(tensors[name].shape)}".encode())
        total.update(tensors[name].contiguous().numpy().tobytes())
    return total.hexdigest()
