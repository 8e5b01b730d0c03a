"""SelectedCodec: the files of the parts in one, each by the codec of its family."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.errors import InvalidInput
from surrogym_server.models.port import DynamicsModel, Learner, ModelCodec, StoredModel
from surrogym_server.models.selected.model import SelectedModel
from surrogym_server.models.selected.selection import Selection

FORMAT = 1
PART = "part"  # of the names of a part's arrays


@dataclass(frozen=True)
class SelectedCodec(ModelCodec):
    """Codec for parts of these families."""

    families: Mapping[str, Learner]

    def encode(self, model: DynamicsModel) -> StoredModel:
        if not isinstance(model, SelectedModel):
            raise TypeError(f"expected a model of selected families, got {type(model).__name__}")
        headers, tensors = [], dict[str, Tensor]()
        for number, (name, part) in enumerate(zip(_names(model.selection), model.parts, strict=True)):
            stored = self.families[name].codec.encode(part)
            headers.append(stored.header)
            tensors |= {f"{PART}{number}.{key}": tensor for key, tensor in stored.tensors.items()}
        return StoredModel({"format": FORMAT, "selection": model.selection.to_json(), "parts": headers}, tensors)

    def decode(self, definition: EnvironmentDefinition, stored: StoredModel) -> SelectedModel:
        header = stored.header
        if header["format"] != FORMAT:
            raise InvalidInput(f"expected a model of format {FORMAT}, got {header['format']!r}")
        selection = Selection.from_json(header["selection"], len(definition.outputs))
        names = _names(selection)
        if not set(names) <= set(self.families) or len(header["parts"]) != len(names):
            raise InvalidInput(f"expected parts of families out of {', '.join(self.families)}, got {names}")
        models = {
            name: self.families[name].codec.decode(definition, StoredModel(own, _tensors(stored, number)))
            for number, (name, own) in enumerate(zip(names, header["parts"], strict=True))
        }
        if len({(part.samples, part.digest) for part in models.values()}) != 1:
            raise InvalidInput("expected parts that were learned from the same samples, got others")
        return SelectedModel.of(definition, models, selection)


def _names(selection: Selection) -> tuple[str, ...]:
    """Families of the parts, in order."""
    return tuple(dict.fromkeys(selection.serving))


def _tensors(stored: StoredModel, number: int) -> dict[str, Tensor]:
    before = f"{PART}{number}."
    return {name.removeprefix(before): array for name, array in stored.tensors.items() if name.startswith(before)}
