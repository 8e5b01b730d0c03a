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
SHOWN = 80  # largest number of characters of a name from a file
MALFORMED = (SafetensorError, ValueError, LookupError, TypeError, AttributeError, RecursionError, OverflowError)


def to_bytes(model: DynamicsModel) -> bytes:
    """Write the whole model, serving arrays included."""
    family = model.definition.learning.model
    stored = learner_of(family).codec.encode(model)
    header = {FAMILY: family.name, **stored.header}
    return save(stored.tensors, {METADATA: json.dumps(header | {CHECKSUM: _checksum(header, stored.tensors)})})


def from_bytes(definition: EnvironmentDefinition, data: bytes) -> DynamicsModel:
    """Read the model that ``to_bytes`` wrote.

    Raises:
        InvalidInput: not such a file, or a damaged one, or one of another family than the definition's, or of an
            environment with other outputs.
    """
    try:
        return _read(definition, data)
    except MALFORMED as error:
        raise InvalidInput(f"expected a Surrogym model in safetensors form, got {len(data)} bytes: {error}") from error


def _read(definition: EnvironmentDefinition, data: bytes) -> DynamicsModel:
    length = int.from_bytes(data[:8], "little")
    header = json.loads(json.loads(data[8 : 8 + length])["__metadata__"][METADATA])
    tensors = load(data)
    _require_whole(header, tensors)
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


def _require_whole(header: dict[str, Any], tensors: dict[str, Tensor]) -> None:
    """Raise ``InvalidInput`` if the content has changed. A file without a checksum is not checked."""
    written = header.pop(CHECKSUM, None)
    if written is not None and written != _checksum(header, tensors):
        raise InvalidInput("the model is damaged: its checksum differs from the one that it was written with")
