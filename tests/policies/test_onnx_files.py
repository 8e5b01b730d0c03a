"""An ONNX file of somebody else is read within bounds: bytes, memory, and no other file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import onnx.inliner
import pytest
from onnx import TensorProto, helper, numpy_helper

from surrogym_trainer.policies import load_policy, onnx_files
from surrogym_trainer.policies.onnx_files import LANES, UnusableOnnx, from_onnx

FLOAT = TensorProto.FLOAT
OBSERVED = helper.make_tensor_value_info("observation", FLOAT, ["lanes", 3])
ACTED = helper.make_tensor_value_info("action", FLOAT, ["lanes", 3])
BIAS = numpy_helper.from_array(np.ones(3, np.float32), "bias")
ADDED = helper.make_node("Add", ["observation", "bias"], ["action"])


def model(nodes: list[onnx.NodeProto], arrays: list[TensorProto], **graph: object) -> onnx.ModelProto:
    graph = {"inputs": [OBSERVED], "outputs": [ACTED], **graph}
    made = helper.make_graph(nodes, "policy", initializer=arrays, **graph)
    return helper.make_model(made, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)


def constant(name: str, *numbers: int) -> TensorProto:
    return numpy_helper.from_array(np.array(numbers, np.int64), name)


def inflated() -> onnx.ModelProto:
    """40,000,000,000 numbers from a file of some 200 bytes."""
    nodes = [
        helper.make_node("ConstantOfShape", ["huge"], ["zeros"]),
        helper.make_node("ReduceSum", ["zeros"], ["sum"], keepdims=0),
        helper.make_node("Add", ["observation", "sum"], ["action"]),
    ]
    return model(nodes, [constant("huge", 200_000, 200_000)])


def multiplied() -> onnx.ModelProto:
    """Sixty doublings of what the policy sees."""
    nodes = [helper.make_node("Concat", [f"x{i}", f"x{i}"], [f"x{i + 1}"], axis=1) for i in range(60)]
    nodes.insert(0, helper.make_node("Identity", ["observation"], ["x0"]))
    nodes.append(helper.make_node("ReduceMean", ["x60"], ["action"], keepdims=1))
    return model(nodes, [])


def of_unknown_shape() -> onnx.ModelProto:
    """As many numbers as the observation says."""
    nodes = [
        helper.make_node("ReduceSum", ["observation"], ["sum"], keepdims=0),
        helper.make_node("Cast", ["sum"], ["count"], to=TensorProto.INT64),
        helper.make_node("Unsqueeze", ["count", "axis"], ["shape"]),
        helper.make_node("ConstantOfShape", ["shape"], ["zeros"]),
        helper.make_node("ReduceSum", ["zeros"], ["nothing"], keepdims=0),
        helper.make_node("Add", ["observation", "nothing"], ["action"]),
    ]
    return model(nodes, [constant("axis", 0)])


def claiming() -> onnx.ModelProto:
    """A shape in the file's own words hides what an operator makes."""
    made = of_unknown_shape()
    made.graph.value_info.append(helper.make_tensor_value_info("zeros", FLOAT, [1]))
    return made


def of_another_file() -> onnx.ModelProto:
    bias = onnx.TensorProto(name="bias", data_type=FLOAT, dims=[3], data_location=TensorProto.EXTERNAL)
    bias.external_data.add(key="location", value="secret.bin")
    return model([ADDED], [bias])


def hidden_in_a_constant() -> onnx.ModelProto:
    made = of_another_file()
    (bias,) = made.graph.initializer
    node = helper.make_node("Constant", [], ["bias"], value=bias)
    return model([node, ADDED], [])


def sparse() -> onnx.ModelProto:
    values = numpy_helper.from_array(np.ones(1, np.float32), "bias")
    array = helper.make_sparse_tensor(values, constant("places", 0), [10**9])
    return model([ADDED], [], sparse_initializer=[array])


def looping() -> onnx.ModelProto:
    inner = helper.make_graph([helper.make_node("Identity", ["observation"], ["same"])], "inner", [], [ACTED])
    inner.output[0].name = "same"
    condition = numpy_helper.from_array(np.array(True), "always")
    return model([helper.make_node("If", ["always"], ["action"], then_branch=inner, else_branch=inner)], [condition])


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (inflated, "expected at most 67108864 numbers in the arrays for 1024 observations, got 40000"),
        (multiplied, "expected at most 67108864 numbers in the arrays for 1024 observations, got "),
        (of_unknown_shape, "expected sizes of the array 'zeros' that follow from those of the input, got"),
        (claiming, "expected sizes of the array 'zeros' that follow from those of the input, got"),
        (of_another_file, "expected all arrays inside the file, got 'bias' in another one"),
        (hidden_in_a_constant, "expected all arrays inside the file, got 'bias' in another one"),
        (sparse, "expected dense arrays, got a sparse one"),
        (looping, "expected one graph, got a loop or a branch"),
    ],
)
def test_an_onnx_policy_with_unbounded_resource_use_is_refused_before_it_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, made: Callable[[], onnx.ModelProto], said: str
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "secret.bin").write_bytes(np.ones(3, np.float32).tobytes())
    monkeypatch.setattr("onnxruntime.InferenceSession", None)
    with pytest.raises(UnusableOnnx, match=r"expected a policy in ONNX, got \d+ bytes") as refused:
        from_onnx(made().SerializeToString())
    assert said in str(refused.value)


def test_an_onnx_policy_with_functions_is_refused_with_a_remedy_that_works():
    opset = [helper.make_opsetid("", 18)]
    own = helper.make_function("own", "Shift", ["x", "b"], ["y"], [helper.make_node("Add", ["x", "b"], ["y"])], opset)
    made = model([helper.make_node("Shift", ["observation", "bias"], ["action"], domain="own")], [BIAS])
    made.functions.append(own)
    made.opset_import.append(helper.make_opsetid("own", 1))
    with pytest.raises(UnusableOnnx, match=r"got the function 'Shift'.*onnx\.inliner\.inline_local_functions"):
        from_onnx(made.SerializeToString())
    policy = from_onnx(onnx.inliner.inline_local_functions(made).SerializeToString())
    np.testing.assert_array_equal(policy(np.zeros((1, 3), np.float32)), np.ones((1, 3), np.float32))


def test_a_too_large_onnx_policy_is_refused_without_reading_all_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(onnx_files, "MAX_BYTES", 1_000)
    (tmp_path / "policy.onnx").write_bytes(bytes(10_000))
    with pytest.raises(UnusableOnnx, match=r"got 1001 bytes .* expected a file of at most 1000 bytes"):
        load_policy(tmp_path / "policy.onnx")


def test_many_observations_of_an_onnx_policy_are_split_into_several_calls():
    policy, many = from_onnx(model([ADDED], [BIAS]).SerializeToString()), np.zeros((2 * LANES + 1, 3), np.float32)
    np.testing.assert_array_equal(policy(many), np.ones((2 * LANES + 1, 3), np.float32))
