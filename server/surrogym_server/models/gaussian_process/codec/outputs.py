"""Conversion of one output of a model to header and tensors, and back, with a check of every number and shape."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any, get_args

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.features import Encoding, FeatureMap, Parity, State, encode, features
from surrogym_server.errors import InvalidInput
from surrogym_server.gp import Hyperparameters, LeftOut, Posterior, Sparse
from surrogym_server.models.gaussian_process.feature_maps import reflection
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel
from surrogym_server.models.gaussian_process.prediction.warp import Warp
from surrogym_server.tensors import STEEPEST
from surrogym_shared.spec import REWARD

KNOWN_MAPS = frozenset(
    FeatureMap(state, action, lead, after, parity=parity)
    for state in get_args(State)
    for action in get_args(Encoding)
    for lead, after in ((False, False), (True, False), (False, True))
    for parity in get_args(Parity)
    if lead or state != "none"
)


def output_tensors(output: OutputModel, prefix: str) -> dict[str, Tensor]:
    """Return the arrays of an output by name. Each name begins with ``prefix``. An output that never varied has no
    arrays."""
    if (posterior := output.posterior) is None:
        return {}
    arrays = {"x": posterior.x, "y": posterior.y, "factor": posterior.factor, "weights": posterior.weights}
    arrays["lengthscale"] = posterior.hyper.lengthscale
    return {f"{prefix}.{name}": tensor.contiguous() for name, tensor in arrays.items()}


def require_output(definition: EnvironmentDefinition, output: OutputModel) -> None:
    """Raise ``InvalidInput`` unless an output's arrays have the right shapes and all its numbers are possible results
    of a fit."""
    _require_drift(definition, output)
    _require_dropped(definition, output)
    _require_warp(output)
    _require_rates(definition, output)
    _require_at_limit(definition, output)
    _require_shared(definition, output)
    _require_size(output)
    _require_shapes(definition, output)
    _require_numbers(output)


def output_header(output: OutputModel) -> dict[str, Any]:
    """Return all fields of an output except its arrays, as values for JSON."""
    entry: dict[str, Any] = {
        "name": output.name,
        "feature_map": asdict(output.feature_map),
        "centre": output.centre,
        "scale": output.scale,
        "left_out": output.left_out,
        "scores": output.scores,
        "posterior": None,
        "warp": None if output.warp is None else asdict(output.warp),
        "past_limits": output.past_limits,
        "at_limit": output.at_limit,
        "shared": output.shared,
        "size_with_prior": output.size_with_prior,
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
        if posterior.sparse is not None:
            entry["posterior"]["sparse"] = asdict(posterior.sparse)
    return entry


def read_output(
    definition: EnvironmentDefinition, entry: dict[str, Any], tensors: Mapping[str, Tensor], prefix: str
) -> OutputModel:
    """Build an output from its entry in the header and its arrays, whose names in ``tensors`` begin with ``prefix``.

    Raises:
        LookupError, TypeError, ValueError: the entry is malformed.
    """
    feature_map = _feature_map(entry["feature_map"])
    shorter = (None, *range(max(definition.ages)))
    plain = replace(feature_map, drift=(), history=None, rates=(), dropped=())
    if plain not in KNOWN_MAPS or feature_map.history not in shorter:
        raise ValueError(
            f"expected a feature map (encoding of state and action) that this version knows, got {feature_map}; "
            "export the model again"
        )
    mirror = reflection(definition, feature_map)
    if feature_map.parity and mirror is None:
        raise ValueError(
            "expected a feature map (encoding of state and action) without parity, because the environment has no "
            f"mirror symmetry, got {feature_map}; export the model again"
        )
    posterior = None
    if (header := entry["posterior"]) is not None:
        arrays = {n: tensors[f"{prefix}.{n}"] for n in ("x", "y", "factor", "weights", "lengthscale")}
        hyper = Hyperparameters(
            arrays["lengthscale"],
            float(header["signal_variance"]),
            float(header["linear_variance"]),
            float(header["quadratic_variance"]),
            float(header["noise_variance"]),
            mirror,
        )
        x, y, factor, weights = (arrays[name] for name in ("x", "y", "factor", "weights"))
        jitter, sparse = float(header["jitter"]), _sparse(header.get("sparse"))
        posterior = Posterior(hyper, x, y, factor, weights, jitter, sparse)
    scores = tuple((name, score) for name, score in entry["scores"])
    centre, scale = float(entry["centre"]), float(entry["scale"])
    name, left_out, warp = str(entry["name"]), int(entry["left_out"]), _warp(entry["warp"])
    past_limits = bool(entry["past_limits"])
    at_limit = tuple(int(side) for side in entry["at_limit"])
    shared = tuple(str(other) for other in entry["shared"])
    size = None if (size := entry["size_with_prior"]) is None else float(size)
    return OutputModel(
        name, feature_map, posterior, centre, scale, left_out, scores, warp, past_limits, at_limit, shared, size
    )


def _warp(entry: dict[str, Any] | None) -> Warp | None:
    return None if entry is None else Warp(*(float(entry[name]) for name in ("base", "sign", "size")))


def _sparse(entry: dict[str, Any] | None) -> Sparse | None:
    if entry is None:
        return None
    errors = entry["left_out"]
    left_out = LeftOut(*(float(errors[name]) for name in ("error", "within_one", "within_two", "log_density")))
    return Sparse(int(entry["points"]), float(entry["unexplained"]), left_out)


def _feature_map(entry: dict[str, Any]) -> FeatureMap:
    drift = tuple(tuple(float(w) for w in row) for row in entry["drift"])
    rates = tuple(float(rate) for rate in entry["rates"])
    places = tuple(int(place) for place in entry["dropped"])
    return FeatureMap(**{**entry, "drift": drift, "rates": rates, "dropped": places})


def _require_drift(definition: EnvironmentDefinition, output: OutputModel) -> None:
    if not (drift := output.feature_map.drift):
        return
    shape = (len(definition.angles), len(definition.coordinates))
    if len(drift) != shape[0] or any(len(row) != shape[1] or not all(map(math.isfinite, row)) for row in drift):
        raise InvalidInput(
            f"output {output.name!r}: expected the drift as finite numbers, one row for each angle and one column for "
            f"each coordinate: {shape}, got {drift}; export the model again"
        )


def _require_dropped(definition: EnvironmentDefinition, output: OutputModel) -> None:
    """Raise ``InvalidInput`` unless the features that an output ignores are features of its feature map, in ascending
    order, and at least one feature remains."""
    if not (places := output.feature_map.dropped):
        return
    count = len(features(definition, replace(output.feature_map, rates=(), dropped=())))
    ordered = list(places) == sorted(set(places))
    if output.posterior is None or not ordered or len(places) >= count or not 0 <= min(places) <= max(places) < count:
        raise InvalidInput(
            f"output {output.name!r}: expected `dropped`, the inputs that it ignores, as ascending indices of some, "
            f"not all, of the inputs 0 to {count - 1}, got {places}; export the model again"
        )


def _require_size(output: OutputModel) -> None:
    """Check an output that is added to a prior model's prediction. Raise ``InvalidInput`` unless the standard deviation
    of their sum over the samples (``size_with_prior``) is finite and above 0, and the output is not learned by its
    logarithm (``warp``)."""
    size = output.size_with_prior
    if size is not None and (not 0 < size < math.inf or output.warp is not None):
        raise InvalidInput(
            f"output {output.name!r}: expected `size_with_prior` (its standard deviation, if it adds to a prior model) "
            f"as a finite number above 0, without a `warp` (learned logarithm), got {size} and {output.warp}; export "
            "the model again"
        )


def _require_warp(output: OutputModel) -> None:
    """Raise ``InvalidInput`` if an output other than a learned reward has a ``warp`` (was learned by its logarithm), or
    if the numbers of the ``warp`` are invalid."""
    if output.warp is None:
        return
    if output.name != REWARD or output.posterior is None or not output.warp.finite:
        raise InvalidInput(
            f"output {output.name!r}: expected `warp` (learned logarithm) only for a learned reward and with finite "
            f"numbers, got {output.warp}; export the model again"
        )


def _require_rates(definition: EnvironmentDefinition, output: OutputModel) -> None:
    """Raise ``InvalidInput`` if an output has invalid rates (see ``gp.growth``). Valid are rates of a transition
    output, one for each feature, with which the amplitude is above 0 at all points of its process."""
    if not (rates := output.feature_map.rates):
        return
    plain = replace(output.feature_map, rates=())
    may = [feature.function == "affine" for feature in features(definition, plain)]
    if (
        output.name not in definition.outputs[:-1]
        or output.posterior is None
        or plain.lead
        or plain.parity
        or len(rates) != len(may)
        or not all(abs(rate) <= STEEPEST and (able or rate == 0) for rate, able in zip(rates, may, strict=True))
    ):
        raise InvalidInput(
            f"output {output.name!r}: expected `rates` only for a transition: a number of at most {STEEPEST:g} in size "
            f"for each of {len(may)} inputs, 0 where the input can't have a rate, got {rates}; export the model again"
        )
    if not bool((1 + output.posterior.x * torch.tensor(rates, dtype=torch.float64) > 0).all()):
        raise InvalidInput(
            f"output {output.name!r}: expected `rates` (how its changes grow along its inputs) with 1 + rates . x "
            f"above 0 at all samples x, got {rates}; export the model again"
        )


def _require_at_limit(definition: EnvironmentDefinition, output: OutputModel) -> None:
    """Raise ``InvalidInput`` unless ``at_limit``, which marks the points that ended at a limit of the output, belongs
    to a transition output and has one entry for each point of its process."""
    if not (sides := output.at_limit):
        return
    count = 0 if output.posterior is None else len(output.posterior.y)
    if output.name not in definition.outputs[:-1] or len(sides) != count or not set(sides) <= {-1, 0, 1}:
        raise InvalidInput(
            f"output {output.name!r}: expected `at_limit` (which samples ended at its lower or upper limit) only for a "
            f"transition, and -1, 0 or 1 for each of {count} samples, got {len(sides)} entries; export the model again"
        )


def _require_shared(definition: EnvironmentDefinition, output: OutputModel) -> None:
    """Raise ``InvalidInput`` if an output has learned from samples of other outputs, unless it and the other outputs
    are transition outputs."""
    transitions = definition.outputs[:-1]
    if output.shared and not {output.name, *output.shared} <= set(transitions):
        raise InvalidInput(
            f"output {output.name!r}: expected `shared` (outputs from whose samples it learned too) to name some of "
            f"{', '.join(transitions)}, got {output.shared}; export the model again"
        )


def _require_numbers(output: OutputModel) -> None:
    """Raise ``InvalidInput`` unless every number of an output is finite, and positive or not negative where needed."""
    finite, positive, least_zero, tensors = [output.centre], [output.scale], [0.0], []
    if (posterior := output.posterior) is not None:
        hyper = posterior.hyper
        tensors = [posterior.x, posterior.y, posterior.factor, posterior.weights]
        positive += [hyper.signal_variance, hyper.noise_variance, *hyper.lengthscale.tolist()]
        positive += posterior.factor.diagonal().tolist()
        least_zero += [hyper.linear_variance, hyper.quadratic_variance, posterior.jitter]
        if posterior.sparse is not None:
            least_zero += [posterior.sparse.points - len(posterior.y), posterior.sparse.unexplained]
            left_out = posterior.sparse.left_out
            finite += [left_out.log_density]
            least_zero += [left_out.error, left_out.within_one, left_out.within_two]
    if not (
        all(math.isfinite(v) for v in (*finite, *positive, *least_zero))
        and min(positive) > 0
        and min(least_zero) >= 0
        and all(bool(torch.isfinite(t).all()) for t in tensors)
    ):
        raise InvalidInput(
            f"output {output.name!r}: expected finite numbers, with scale, length scales and variances above 0, "
            "got a number that is not; export the model again"
        )


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
            raise InvalidInput(
                f"output {output.name!r}: expected {name} as torch.float64 of shape {shape}, got {got}; export the "
                "model again"
            )
