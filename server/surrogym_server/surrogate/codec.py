"""A model as bytes and back: safetensors with a JSON header. Nothing is pickled, nothing is recomputed on loading."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, replace
from typing import Any, get_args

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from surrogym_server.errors import InvalidInput
from surrogym_server.gp import Hyperparameters, Posterior
from surrogym_server.surrogate.definition import EnvironmentDefinition
from surrogym_server.surrogate.features import Encoding, FeatureMap, State, encode
from surrogym_server.surrogate.model import OutputModel, SurrogateModel

FORMAT = 2
READABLE = (1, 2)  # 1: a reward's timing was the definition's alone
KNOWN_MAPS = frozenset(
    FeatureMap(state, action, lead, after)
    for state in get_args(State)
    for action in get_args(Encoding)
    for lead, after in ((False, False), (True, False), (False, True))
)


def to_bytes(model: SurrogateModel) -> bytes:
    """The whole model, serving arrays included."""
    outputs = (*model.transitions, model.reward)
    tensors: dict[str, Tensor] = {}
    for index, output in enumerate(outputs):
        if (posterior := output.posterior) is not None:
            arrays = {"x": posterior.x, "y": posterior.y, "factor": posterior.factor, "weights": posterior.weights}
            arrays["lengthscale"] = posterior.hyper.lengthscale
            tensors |= {f"{index}.{name}": tensor.contiguous() for name, tensor in arrays.items()}
    header = {
        "format": FORMAT,
        "outputs": [_header(output) for output in outputs],
        "terminal_reward": model.terminal_reward,
        "samples": model.samples,
        "digest": model.digest,
    }
    return save(tensors, {"surrogym": json.dumps(header)})


def from_bytes(definition: EnvironmentDefinition, data: bytes) -> SurrogateModel:
    """The model that ``to_bytes`` stored.

    Raises:
        InvalidInput: not such a file, or one of an environment with other outputs.
    """
    try:
        length = int.from_bytes(data[:8], "little")
        header = json.loads(json.loads(data[8 : 8 + length])["__metadata__"]["surrogym"])
        tensors = load(data)
        stored, terminal_reward = header["format"], float(header["terminal_reward"])
        outputs = tuple(_output(entry, tensors, str(i)) for i, entry in enumerate(header["outputs"]))
        if stored == 1 and definition.reward_timing == "after":
            outputs = (*outputs[:-1], _read_after(outputs[-1]))
        samples, digest = int(header["samples"]), str(header["digest"])
    except (SafetensorError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
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
    for output in outputs:
        _require_shapes(definition, output)
        _require_numbers(output)
    return SurrogateModel(definition, outputs[:-1], outputs[-1], terminal_reward, samples, digest)


def _read_after(reward: OutputModel) -> OutputModel:
    return replace(reward, feature_map=replace(reward.feature_map, after=True))


def _header(output: OutputModel) -> dict[str, Any]:
    entry = {
        "name": output.name,
        "feature_map": asdict(output.feature_map),
        "centre": output.centre,
        "scale": output.scale,
        "left_out": output.left_out,
        "scores": output.scores,
        "posterior": None,
    }
    if (posterior := output.posterior) is not None:
        hyper = posterior.hyper
        entry["posterior"] = {
            "signal_variance": hyper.signal_variance,
            "linear_variance": hyper.linear_variance,
            "quadratic_variance": hyper.quadratic_variance,
            "noise_variance": hyper.noise_variance,
            "jitter": posterior.jitter,
        }
    return entry


def _output(entry: dict[str, Any], tensors: dict[str, Tensor], prefix: str) -> OutputModel:
    posterior = None
    if (stored := entry["posterior"]) is not None:
        arrays = {n: tensors[f"{prefix}.{n}"] for n in ("x", "y", "factor", "weights", "lengthscale")}
        hyper = Hyperparameters(
            arrays["lengthscale"],
            float(stored["signal_variance"]),
            float(stored["linear_variance"]),
            float(stored["quadratic_variance"]),
            float(stored["noise_variance"]),
        )
        posterior = Posterior(
            hyper, arrays["x"], arrays["y"], arrays["factor"], arrays["weights"], float(stored["jitter"])
        )
    scores = tuple((name, score) for name, score in entry["scores"])
    feature_map = FeatureMap(**entry["feature_map"])
    if feature_map not in KNOWN_MAPS:
        raise ValueError(f"unknown feature map {feature_map}")
    centre, scale = float(entry["centre"]), float(entry["scale"])
    return OutputModel(str(entry["name"]), feature_map, posterior, centre, scale, int(entry["left_out"]), scores)


def _require_numbers(output: OutputModel) -> None:
    """Every number finite, and positive where only that makes sense."""
    finite, positive, least_zero, tensors = [output.centre], [output.scale], [0.0], []
    if (posterior := output.posterior) is not None:
        hyper = posterior.hyper
        tensors = [posterior.x, posterior.y, posterior.factor, posterior.weights]
        positive += [hyper.signal_variance, hyper.noise_variance, *hyper.lengthscale.tolist()]
        positive += posterior.factor.diagonal().tolist()
        least_zero += [hyper.linear_variance, hyper.quadratic_variance, posterior.jitter]
    if not (
        all(math.isfinite(v) for v in (*finite, *positive, *least_zero))
        and min(positive) > 0
        and min(least_zero) >= 0
        and all(bool(torch.isfinite(t).all()) for t in tensors)
    ):
        raise InvalidInput(f"output {output.name!r}: expected finite numbers, scales and variances above 0")


def _require_shapes(definition: EnvironmentDefinition, output: OutputModel) -> None:
    if (posterior := output.posterior) is None:
        return
    q = torch.zeros(1, len(definition.coordinates), dtype=torch.float64)
    u = torch.zeros(1, definition.action.size, dtype=torch.float64)
    lead = q.new_zeros(1, len(definition.coordinates))
    width, n = encode(definition, output.feature_map, q, u, lead).shape[1], posterior.y.numel()
    expected = {
        "x": (posterior.x, (n, width)),
        "y": (posterior.y, (n,)),
        "factor": (posterior.factor, (n, n)),
        "weights": (posterior.weights, (n,)),
        "lengthscale": (posterior.hyper.lengthscale, (width,)),
    }
    for name, (tensor, shape) in expected.items():
        if tuple(tensor.shape) != shape or tensor.dtype != torch.float64:
            got = f"{tensor.dtype} {tuple(tensor.shape)}"
            raise InvalidInput(f"output {output.name!r}: expected {name} of torch.float64 {shape}, got {got}")
