"""A model as bytes and back: safetensors with a JSON header. Nothing is pickled, nothing is recomputed on loading."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import replace
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load, save
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
from surrogym_server.models.gaussian_process.prediction.model import GaussianProcessModel
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel
from surrogym_server.models.gaussian_process.prediction.regions import TERMINATION

FORMAT = 3
CHECKSUM = "checksum"
JUMP = "jump"  # before the names of its arrays
MALFORMED = (SafetensorError, ValueError, LookupError, TypeError, AttributeError, RecursionError, OverflowError)
READABLE = (1, 2, 3)  # 1: a reward's timing was the definition's alone; 2: no drift


def to_bytes(model: GaussianProcessModel) -> bytes:
    """The whole model, serving arrays included."""
    outputs = (*model.transitions, model.reward)
    tensors: dict[str, Tensor] = {} if model.ending is None else region_tensors(model.ending, TERMINATION)
    for index, jump in enumerate(model.jumps):
        tensors |= region_tensors(jump.region, f"{JUMP}.{index}")
    for index, output in enumerate(outputs):
        tensors |= output_tensors(output, str(index))
    header = {
        "format": FORMAT,
        "outputs": [output_header(output) for output in outputs],
        "terminal_reward": model.terminal_reward,
        "samples": model.samples,
        "digest": model.digest,
        "jumps": [[jump.size, region_header(jump.region)] for jump in model.jumps],
        "termination": None if model.ending is None else region_header(model.ending),
    }
    return save(tensors, {"surrogym": json.dumps(header | {CHECKSUM: _checksum(header, tensors)})})


def from_bytes(definition: EnvironmentDefinition, data: bytes) -> GaussianProcessModel:
    """The model that ``to_bytes`` stored.

    Raises:
        InvalidInput: not such a file, one that is damaged, or one of an environment with other outputs.
    """
    try:
        length = int.from_bytes(data[:8], "little")
        header = json.loads(json.loads(data[8 : 8 + length])["__metadata__"]["surrogym"])
        tensors = load(data)
        _require_whole(header, tensors)
        stored, terminal_reward = header["format"], float(header["terminal_reward"])
        outputs = tuple(read_output(definition, entry, tensors, str(i)) for i, entry in enumerate(header["outputs"]))
        if stored == 1 and definition.reward_timing == "after":
            outputs = (*outputs[:-1], _read_after(outputs[-1]))
        samples, digest = int(header["samples"]), str(header["digest"])
        ending = read_region(definition, header.get("termination"), tensors, TERMINATION)
        jumps = read_jumps(definition, header.get("jumps", []), tensors, JUMP)
    except MALFORMED as error:
        raise InvalidInput(f"expected a Surrogym model in safetensors form, got {len(data)} bytes: {error}") from error
    names = tuple(output.name for output in outputs)
    if stored not in READABLE or names != definition.outputs:
        raise InvalidInput(
            f"expected a model of format {FORMAT} with outputs {definition.outputs}, got format {stored} with {names}"
        )
    if not math.isfinite(terminal_reward) or samples < 1:
        raise InvalidInput(f"expected a finite terminal reward and samples, got {terminal_reward} and {samples}")
    if any(output.feature_map.after for output in outputs[:-1]):
        raise InvalidInput(
            "expected transition outputs that read the state before the step, got one that reads its own"
        )
    if (ending is not None) != definition.learns_termination:
        learned, got = ("learned" if x else "declared" for x in (definition.learns_termination, ending))
        raise InvalidInput(f"expected a model of an environment whose termination is {learned}, got {got}")
    known, reward = definition.declared_reward, outputs[-1]
    if known is not None and (reward.posterior, reward.centre, reward.feature_map.after) != (None, 0.0, known.after):
        raise InvalidInput("expected a model without a reward of its own, as the environment's is declared")
    for output in outputs:
        require_output(definition, output)
    for region in (*(jump.region for jump in jumps), *([] if ending is None else [ending])):
        require_region(region)
    if not all(math.isfinite(jump.size) for jump in jumps):
        raise InvalidInput(f"expected jumps of finite sizes, got {[jump.size for jump in jumps][:4]}")
    return GaussianProcessModel(definition, outputs[:-1], outputs[-1], terminal_reward, samples, digest, ending, jumps)


def _checksum(header: dict[str, Any], tensors: dict[str, Tensor]) -> str:
    """SHA-256 of all that the file says, however its arrays are laid out in it."""
    total = hashlib.sha256(json.dumps(header).encode())
    for name in sorted(tensors):
        total.update(f"{name} {tensors[name].dtype} {list(tensors[name].shape)}".encode())
        total.update(tensors[name].contiguous().numpy().tobytes())
    return total.hexdigest()


def _require_whole(header: dict[str, Any], tensors: dict[str, Tensor]) -> None:
    """Raise ``InvalidInput`` where something is not as it was written; files from before have no checksum."""
    written = header.pop(CHECKSUM, None)
    if written is not None and written != _checksum(header, tensors):
        raise InvalidInput("expected a model as it was written, got one with another checksum: the file is damaged")


def _read_after(reward: OutputModel) -> OutputModel:
    return replace(reward, feature_map=replace(reward.feature_map, after=True))
