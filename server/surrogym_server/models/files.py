"""A model as one file: safetensors with a JSON header that names its family. The file holds no pickles and no code."""

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
from surrogym_server.models.registry import MODELS, SHORT, learner_of

METADATA = "surrogym"
FAMILY, CHECKSUM = "family", "checksum"
SHOWN = 80  # greatest number of characters of a file's content that a message quotes
MALFORMED = (SafetensorError, ValueError, LookupError, TypeError, AttributeError, RecursionError, OverflowError)


def to_bytes(model: DynamicsModel) -> bytes:
    """Return a model as the bytes of a file. It includes the results of long computations, so that loading does not
    repeat them."""
    family = model.definition.learning.model
    data = learner_of(family).codec.encode(model)
    return with_checksum({FAMILY: family.name, **data.header}, data.tensors)


def with_checksum(header: dict[str, Any], tensors: dict[str, Tensor]) -> bytes:
    """Return a header that JSON can represent, and named tensors, as the bytes of a file with a checksum of both."""
    return save(tensors, {METADATA: json.dumps(header | {CHECKSUM: _checksum(header, tensors)})})


def from_bytes(definition: EnvironmentDefinition, data: bytes) -> DynamicsModel:
    """Read the model that ``to_bytes`` wrote.

    Raises:
        InvalidInput: the bytes are not a model file, the file is damaged, or its model has another family or other
            outputs than the definition.
    """
    header, tensors = _content(data)
    try:
        return _model(definition, header, tensors)
    except KeyError as error:
        raise InvalidInput(
            f"expected a model file with the entry {str(error)[:SHOWN]}, got a file without it; export the model again"
        ) from error
    except MALFORMED as error:
        raise InvalidInput(
            "expected a model file whose entries have valid types and sizes, got a file with an invalid entry; "
            "export the model again"
        ) from error


def _content(data: bytes) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Return header and tensors of a file. Raises ``InvalidInput`` unless the checksum in the file is that of header
    and tensors."""
    length = int.from_bytes(data[:8], "little")
    try:
        header = json.loads(json.loads(data[8 : 8 + length])["__metadata__"][METADATA])
        tensors = load(data)
        written = header.pop(CHECKSUM)
    except MALFORMED as error:
        raise InvalidInput(
            f"expected a model file of Surrogym (safetensors with a checksum), got {len(data)} bytes of another form; "
            "export the model again"
        ) from error
    if written != _checksum(header, tensors):
        raise InvalidInput("the model file is damaged: its content does not match its checksum; export the model again")
    return header, tensors


def _model(definition: EnvironmentDefinition, header: dict[str, Any], tensors: dict[str, Tensor]) -> DynamicsModel:
    expected, got = definition.learning.model, header.pop(FAMILY)
    if str(got) in SHORT or MODELS.instead_of(str(got)) is not None:
        raise InvalidInput(
            f"expected a model of this version, got one of the family {got!r}, which another version wrote: "
            "export its samples with that version, and learn from them again"
        )
    if got != expected.name:
        raise InvalidInput(
            f"expected a model of the family {expected.name!r}, as the specification says, "
            f"got one of {str(got)[:80]!r}; load a model of the expected family, or change `model` in the "
            "specification's `design`"
        )
    return learner_of(expected).codec.decode(definition, StoredModel(header, tensors))


def _checksum(header: dict[str, Any], tensors: dict[str, Tensor]) -> str:
    """Return the SHA-256 of header and tensors, independent of the order of the tensors in the file."""
    total = hashlib.sha256(json.dumps(header).encode())
    for name in sorted(tensors):
        total.update(f"{name} {tensors[name].dtype} {list(tensors[name].shape)}".encode())
        total.update(tensors[name].contiguous().numpy().tobytes())
    return total.hexdigest()
