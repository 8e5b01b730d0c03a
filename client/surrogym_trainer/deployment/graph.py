"""A controller's network as an ONNX file that contains a description: names, order, units, scales and limits.

Shapes: N rows, D observation entries, A outputs, F action entries.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_shared.rates import within_rates
from surrogym_trainer.deployment.c.files import prefix_of
from surrogym_trainer.deployment.controller import Array, Controller, Guard, Observed, Remembered
from surrogym_trainer.deployment.reference import begin, decide, observe
from surrogym_trainer.deployment.running import Running
from surrogym_trainer.policies.onnx_files import INPUT, OUTPUT

OPSET = 17
IR_VERSION = 9  # version of ONNX's file format that onnxruntime 1.20 can read
KEY = "surrogym"  # key of the description in the file's metadata


def write(controller: Controller, folder: Path) -> None:
    """Write ``NAME.onnx`` into a folder: observation (N, D) to action (N, F), in float32, or int64 for a discrete
    action.

    Raises:
        ModuleNotFoundError: the extra ``export`` is not installed.
    """
    import onnx

    model = _model(controller)
    onnx.checker.check_model(model)
    (folder / f"{prefix_of(controller)}.onnx").write_bytes(model.SerializeToString())


def description(controller: Controller) -> dict[str, Any]:
    """Return everything that a program needs to use the network, as a JSON object."""
    names, decision = controller.coordinates, controller.decision
    choices: tuple[int | None, ...] = decision.counts or (None,) * len(controller.low)
    return {
        "measurements": [
            {"name": m.name, "unit": m.unit, "angle": m.angle, "low": _finite(m.low), "high": _finite(m.high)}
            | {"sensor": [m.lowest, m.highest]}  # range of valid readings of the sensor; other readings are faults
            for m in controller.measurements
        ],
        "lags": [{"name": lag.name, "is": _lag(lag, names), "start": lag.start} for lag in controller.lags],
        "observation": [
            {"name": o.name, "unit": o.unit, "is": _term(o, names), "low": _finite(o.smallest)}
            | {"high": _finite(o.largest), "mean": float(mean), "deviation": float(deviation)}
            for o, mean, deviation in zip(controller.observation, decision.mean, decision.deviation, strict=True)
        ],
        "action": [
            {"low": float(low), "high": float(high), "choices": n, "fallback": float(fallback)}
            for low, high, n, fallback in zip(
                controller.low, controller.high, choices, controller.fallback, strict=True
            )
        ],
        "reading": "a reading outside of sensor is a fault, and the action is the fallback; an angle is wrapped to "
        "[-pi, pi); another measurement is clipped to low and high; lags follow from earlier steps",
        "scaling": "inside: give observations in their units; actions come in theirs, within low and high",
        **({} if controller.guard is None else _limits(controller.guard, names)),
        **({} if not controller.rates else _rates(controller)),
        "sampling_period": controller.period,
        "timeout": _finite(controller.timeout),
        "sha256": controller.digests,
    }


def _limits(guard: Guard, names: tuple[str, ...]) -> dict[str, Any]:
    """Return the limits of a controller as a JSON object. The network does not keep them by itself."""
    return {
        "limits": [
            {"name": limit.term.name, "is": _term(limit.term, names), "margin": limit.margin}
            | {"low": _finite(limit.low), "high": _finite(limit.high)}
            for limit in guard.limits
        ],
        "fallback": [_term(term, names) for term in guard.fallback],
        "keeping": "not inside: apply the fallback if the distance to an end of a limit is below its margin, now or "
        "after one more step with the same change",
    }


def _rates(controller: Controller) -> dict[str, Any]:
    """Return the largest change per step (rate) of each action entry that has one, as a JSON object. The network does
    not keep the rates by itself."""
    return {
        "rates": [{"entry": rate.entry, "largest_change": rate.change} for rate in controller.rates],
        "keeping_rates": "not inside: an entry of the action may change by at most largest_change in a step",
    }


class RunningGraph(Running):
    """A controller whose network is an ONNX file, run by onnxruntime. NumPy computes the observation, because the file
    contains only the network.

    Args:
        controller: the controller that the file was made from.
        act: the network, from observations (N, D) in float32 to actions (N, F).
    """

    single = True

    def __init__(self, controller: Controller, act: Callable[[NDArray[np.float32]], NDArray[Any]]) -> None:
        self._controller, self._act = controller, act
        self._memory = begin(controller)

    def reset(self) -> None:
        self._memory = begin(self._controller)

    def step(self, measurement: Array, age: float = 0.0) -> tuple[int, Array]:
        self._memory, action, (status,) = decide(self._controller, self._memory, measurement[None], age)
        if status == 0:
            shown = observe(self._controller, self._memory.coordinates).astype(np.float32)
            asked = self._act(shown).astype(np.float64)
            action = within_rates(self._controller.rates, self._memory.coordinates, asked)
            self._memory = replace(self._memory, action=action.astype(np.float32).astype(np.float64))
        return int(status), action[0]


@contextmanager
def running(controller: Controller) -> Iterator[RunningGraph]:
    """Write the ONNX file of a controller, and load it in onnxruntime.

    Raises:
        ModuleNotFoundError: the extra ``export`` is not installed.
    """
    from onnxruntime import InferenceSession

    session = InferenceSession(_model(controller).SerializeToString(), providers=["CPUExecutionProvider"])
    yield RunningGraph(controller, lambda observations: session.run([OUTPUT], {INPUT: observations})[0])


def _model(controller: Controller) -> Any:
    from onnx import TensorProto, helper, numpy_helper

    decision, graph = controller.decision, _Graph()
    x = graph.add("Div", graph.add("Sub", INPUT, decision.mean), decision.deviation)
    if np.isfinite(decision.clip):
        x = graph.add("Clip", x, np.array(-decision.clip), np.array(decision.clip))
    for layer in decision.layers:
        x = graph.add("Add", graph.add("MatMul", x, layer.weights), layer.bias)
        if layer.activation != "none":
            x = graph.add({"tanh": "Tanh", "relu": "Relu"}[layer.activation], x)
    if decision.counts:
        x, kind = _chosen(graph, x, controller)
    else:
        shown = graph.add("Tanh", x) if decision.squash else x
        scaled = graph.add("Add", graph.add("Mul", shown, decision.reach), decision.centre)
        x, kind = graph.add("Min", graph.add("Max", scaled, controller.low), controller.high), TensorProto.FLOAT
    graph.nodes.append(helper.make_node("Identity", [x], [OUTPUT]))
    about = description(controller)
    order = ", ".join(entry["name"] for entry in about["observation"])
    d, f = len(controller.observation), len(controller.low)
    made = helper.make_graph(
        graph.nodes,
        "controller",
        [helper.make_tensor_value_info(INPUT, TensorProto.FLOAT, ["N", d], doc_string=order)],
        [helper.make_tensor_value_info(OUTPUT, kind, ["N", f])],
        [numpy_helper.from_array(array, name) for name, array in graph.arrays.items()],
    )
    model = helper.make_model(made, opset_imports=[helper.make_opsetid("", OPSET)], producer_name=KEY)
    model.ir_version = IR_VERSION
    model.doc_string = f"Controller of {controller.name}. Metadata {KEY!r} has order, units, scales and limits as JSON."
    helper.set_model_props(model, {KEY: json.dumps(about)})
    return model


def _chosen(graph: _Graph, scores: str, controller: Controller) -> tuple[str, int]:
    """Add the nodes that choose the largest of the outputs (``scores``) for each entry of the action. Returns the name
    of the result, and its type.

    If a continuous action was divided into discrete values, the result is the value; otherwise, the number of the
    choice.
    """
    from onnx import TensorProto

    counts, first, chosen = controller.decision.counts, 0, []
    for count in counts:
        # inputs of ONNX's operator Slice: starts, ends and axes
        where = [np.array([i], dtype=np.int64) for i in (first, first + count, 1)]
        group = graph.add("Slice", scores, *where)
        chosen.append(graph.add("ArgMax", group, axis=1, keepdims=1))
        first += count
    index = graph.add("Concat", *chosen, axis=1)
    step = (controller.high - controller.low) / (np.array(counts) - 1)
    if (controller.low == 0).all() and (step == 1).all():
        return index, TensorProto.INT64
    scaled = graph.add("Mul", graph.add("Cast", index, to=TensorProto.FLOAT), step)
    return graph.add("Add", scaled, controller.low), TensorProto.FLOAT


class _Graph:
    """The nodes and arrays of an ONNX graph to which nodes are added."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.arrays: dict[str, NDArray[Any]] = {}

    def add(self, operator: str, *inputs: str | NDArray[Any], **attributes: Any) -> str:
        """Add a node, and return the name of its output. Real numbers are stored as float32."""
        from onnx import helper

        names = [given if isinstance(given, str) else self._array(given) for given in inputs]
        output = f"{operator.lower()}{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, names, [output], **attributes))
        return output

    def _array(self, array: NDArray[Any]) -> str:
        name = f"array{len(self.arrays)}"
        self.arrays[name] = array if array.dtype.kind == "i" else array.astype(np.float32)
        return name


def _term(entry: Observed, names: tuple[str, ...]) -> str:
    """Return in words how an entry of the observation is computed, such as "cos(angle)"."""
    parts = []
    for part in entry.parts:
        inner = " + ".join(names[place] if w == 1 else f"{w!r} * {names[place]}" for place, w in part.weights)
        value = {"one": "", "linear": inner, "sin": f"sin({inner})", "cos": f"cos({inner})"}[part.function]
        factor = repr(part.coefficient)
        parts.append(factor if not value else value if part.coefficient == 1 else f"{factor} * ({value})")
    total = " + ".join(parts)
    if np.isinf(entry.low) and np.isinf(entry.high):
        return total
    return f"clip({total}, {entry.low!r}, {entry.high!r})"


def _lag(lag: Remembered, names: tuple[str, ...]) -> str:
    """Return in words which earlier value, change or action a lag repeats."""
    match lag.kind:
        case "action":
            return f"entry {lag.source} of the last action"
        case "steps":
            return "steps since the reset"
        case "value":
            return f"{names[lag.source]} one step before"
        case "change":
            return f"change of {names[lag.source]} in the last step" + (", by at most half a turn" if lag.angle else "")
        case "sum":
            return (
                f"integral: each step but the first adds ({names[lag.source]} - {lag.set_point!r}) / {lag.unit!r}, "
                f"clipped to {lag.low:g} to {lag.high:g}; a fault adds nothing"
            )


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
