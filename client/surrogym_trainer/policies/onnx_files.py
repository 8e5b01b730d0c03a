"""Loading of a policy in ONNX as a function of observations. Its memory is bounded by the file's shapes before anything
runs."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_client.errors import SurrogymClientError
from surrogym_trainer.policies.predict import Predict

MAX_BYTES = 256 * 1024 * 1024  # largest size of a policy's ONNX file
LANES = 1_024  # largest number of observations in one call of the network; more observations take several calls
MAX_NUMBERS = 64 * 1024 * 1024  # largest number of numbers in all arrays of one call together, including the weights
INPUT, OUTPUT = "observation", "action"


class UnusableOnnx(SurrogymClientError):
    """The file is not a policy in ONNX, or it could need more memory than a policy should."""


def load_onnx(path: Path) -> Predict:
    """Load a policy from its ONNX file.

    Raises:
        OSError: the file can't be read.
        ModuleNotFoundError: the extra ``export`` is not installed.
        UnusableOnnx: the file is not a policy, or is too large.
    """
    with path.open("rb") as file:
        return from_onnx(file.read(MAX_BYTES + 1))


def from_onnx(content: bytes) -> Predict:
    """Convert the bytes of an ONNX model to a function of observations. No Python code in it is run, and no other file
    is read.

    Raises:
        ModuleNotFoundError: the extra ``export`` is not installed.
        UnusableOnnx: the model is not a policy, or is larger than ``MAX_BYTES`` or ``MAX_NUMBERS`` allow.
    """
    import onnxruntime

    try:
        _check(content)
        session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    except Exception as error:  # errors of onnx and onnxruntime have no common base class
        raise UnusableOnnx(
            f"expected a policy in ONNX, got {len(content)} bytes that can't be used: {error}"
        ) from error

    def predict(observations: NDArray[np.float32]) -> NDArray[Any]:
        parts = [observations[first : first + LANES] for first in range(0, max(len(observations), 1), LANES)]
        actions = [session.run([OUTPUT], {INPUT: part.astype(np.float32)})[0] for part in parts]
        return actions[0] if len(actions) == 1 else np.concatenate(actions)

    return predict


def _check(content: bytes) -> None:
    """Check that the shape of every array follows from the file, and that all of them together are small.

    Raises:
        ValueError: a shape is unknown, or the arrays are too large.
    """
    import onnx

    if len(content) > MAX_BYTES:
        raise ValueError(f"expected a file of at most {MAX_BYTES} bytes, got more: export a smaller network")
    model = onnx.load_model_from_string(content)
    _check_self_contained(model)
    _for_lanes(model.graph)
    inferred = onnx.shape_inference.infer_shapes(model, strict_mode=True, data_prop=True)
    numbers = _numbers(inferred.graph)
    if numbers > MAX_NUMBERS:
        raise ValueError(
            f"expected at most {MAX_NUMBERS} numbers in the arrays for {LANES} observations, got {numbers}: export a "
            "smaller network"
        )


def _check_self_contained(model: Any) -> None:
    """Raise ``ValueError`` if a model reads another file, or has parts without shapes of their own: subgraphs,
    functions, sparse arrays."""
    import onnx

    if model.functions:
        raise ValueError(
            f"expected only operators of ONNX, got the function {model.functions[0].name!r}, which the file defines: "
            "write the file again with its functions inlined, by onnx.inliner.inline_local_functions(model)"
        )
    for message in _messages(model):
        match message:
            case onnx.TensorProto(data_location=onnx.TensorProto.EXTERNAL):
                raise ValueError(
                    f"expected all arrays inside the file, got {message.name!r} in another one: export it without "
                    "external data"
                )
            case onnx.SparseTensorProto():
                raise ValueError("expected dense arrays, got a sparse one: export the policy without sparse arrays")
            case onnx.GraphProto() if message is not model.graph:
                raise ValueError(
                    "expected one graph, got a loop or a branch in it: export the policy without control flow"
                )


def _messages(message: Any) -> Iterator[Any]:
    """Yield all messages within a protobuf message, at any depth."""
    for field, value in message.ListFields():
        if field.message_type is not None:
            for inner in value if field.is_repeated else [value]:
                yield inner
                yield from _messages(inner)


def _for_lanes(graph: Any) -> None:
    """Set the number of observations to ``LANES``, and remove the shapes that the file claims, so that all are
    inferred."""
    weights = {array.name for array in graph.initializer}
    inputs = [given for given in graph.input if given.name not in weights]
    if [given.name for given in inputs] != [INPUT] or len(inputs[0].type.tensor_type.shape.dim) != 2:
        raise ValueError(
            f"expected one input {INPUT!r} with 2 dimensions, got the inputs {[given.name for given in inputs]}: "
            "rename or flatten them"
        )
    inputs[0].type.tensor_type.shape.dim[0].dim_value = LANES
    del graph.value_info[:]
    for given in graph.output:
        given.ClearField("type")


def _numbers(graph: Any) -> int:
    """Return the number of numbers in all arrays of a graph whose shapes have been inferred."""
    known = {value.name: value.type.tensor_type for value in (*graph.input, *graph.value_info, *graph.output)}
    weights = sum(math.prod(map(int, array.dims)) for array in graph.initializer)
    made = [name for node in graph.node for name in node.output if name]
    return weights + sum(_size(name, known.get(name)) for name in (INPUT, *made))


def _size(name: str, tensor: Any) -> int:
    if tensor is None or not tensor.HasField("shape") or not all(d.HasField("dim_value") for d in tensor.shape.dim):
        raise ValueError(
            f"expected sizes of the array {name!r} that follow from those of the input, got an array of unknown size: "
            "export the policy again so that only the number of observations is dynamic"
        )
    return math.prod(int(d.dim_value) for d in tensor.shape.dim)
