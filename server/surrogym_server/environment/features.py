"""Inputs of models: encodings of coordinates and action, scaled so that each feature has standard deviation near 1."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import groupby
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition, wrap
from surrogym_server.environment.distributions import scaling
from surrogym_server.environment.points import Points
from surrogym_server.tensors import bend

State = Literal["cos_sin", "wrapped", "both", "observation", "none"]
Encoding = Literal["value", "one_hot", "none"]  # how an action is encoded as inputs; one_hot only for a discrete one
Parity = Literal["", "odd", "even"]
# For each angle, C weights: the sum of the C coordinates times these weights predicts the angle's change in one step.
Drift = tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class FeatureMap:
    """Encoding of coordinates q and action u as the inputs of the Gaussian process of one output.

    Attributes:
        state: how angles are encoded: as cos and sin, as the wrapped angle, or both. Or ``observation``: the
            observation replaces the coordinates, standardised except in preset paper. Or ``none``: neither coordinates
            nor action are inputs, only the lead.
        action: how discrete actions are encoded: ``value`` as evenly spaced values, ``one_hot``, or ``none``.
        lead: whether the lead is an input too: the predicted next value of each leading coordinate (see ``leading``),
            clipped to its limits. With it, an output that depends on a limited speed, such as an angle, has no kink
            where the speed reaches its limit.
        after: whether to encode the state after the step instead of the one before; only for the reward.
        drift: for each angle, weights (C,) of q that predict its increment; cos and sin of the angle after this
            increment are inputs too.
        parity: how the output changes if every coordinate and the action change their sign: it changes its sign too
            (odd), it stays (even), or there is no rule (empty).
        history: only lags that look back at most this many steps are inputs; None: all lags.
        rates: (d,) rate of each feature that is not dropped. With a rate above 0, the output changes the faster the
            larger the feature is (see ``gp.growth``). Empty if no feature has a rate.
        dropped: indices of the features that the output does not read, among all features of the map, ascending.
    """

    state: State = "cos_sin"
    action: Encoding = "value"
    lead: bool = False
    after: bool = False
    drift: Drift = ()
    parity: Parity = ""
    history: int | None = None
    rates: tuple[float, ...] = ()
    dropped: tuple[int, ...] = ()

    def __str__(self) -> str:
        extras = [name for name in ("lead", "after", "drift", "rates") if getattr(self, name)]
        extras += [] if self.history is None else [f"history {self.history}"]
        extras += ["without " + " ".join(map(str, self.dropped))] if self.dropped else []
        return ", ".join([self.state, f"action {self.action}", *extras, *([self.parity] if self.parity else [])])


def leading(definition: EnvironmentDefinition) -> tuple[int, ...]:
    """Return the indices of the leading coordinates: those with two finite bounds, such as a limited speed, except
    coordinates with a wall, which is a bound at which another coordinate becomes 0.

    Models predict leading coordinates first, because their next value can be an input of other outputs.
    """
    return tuple(
        i
        for i in definition.moving
        if definition.stopped[i] is None and all(map(math.isfinite, definition.coordinates[i].saturation))
    )


class Feature(NamedTuple):
    """One input of a Gaussian process: ``function`` of one entry of coordinates and action [q, u], of the next value of
    one leading coordinate (see ``leading``), or of a weighted sum of coordinates; or one observation entry."""

    function: Literal[
        "affine", "cos", "sin", "turned_cos", "turned_sin", "wrapped", "equal", "observed", "lead", "grown"
    ]
    entry: int
    centre: float = 0.0  # subtracted from the entry; for function "equal", the value with which the entry is compared
    scale: float = 1.0
    # (C,) for functions "turned_cos" and "turned_sin", the weights of the coordinates in the angle.
    weights: tuple[float, ...] = ()
    rate: float = 0.0  # for function "grown", the rate of the exponential transformation ``bend``


def feature_names(definition: EnvironmentDefinition, feature_map: FeatureMap) -> list[str]:
    """Return a name for each feature of a feature map, in order, for display: the name of a coordinate, action entry or
    observation entry, if needed with its function."""
    entries = (*definition.coordinate_names, *(f"action {place}" for place in range(definition.action.size)))
    names = []
    for function, entry, centre, *_ in features(definition, feature_map):
        if function == "observed":
            names.append(definition.observation_names[entry])
        elif function == "lead":
            names.append(f"next {definition.coordinate_names[leading(definition)[entry]]}")
        elif function in ("affine", "grown"):
            names.append(entries[entry])
        elif function == "equal":
            names.append(f"{entries[entry]} = {centre:g}")
        else:
            names.append(f"{function.replace('turned_', 'next ')} {entries[entry]}")
    return names


def features(definition: EnvironmentDefinition, feature_map: FeatureMap) -> tuple[Feature, ...]:
    """Return the features that a feature map describes, in order: coordinates, action, lead; without dropped ones."""
    result = [] if feature_map.state == "none" else _of_point(definition, feature_map)
    if feature_map.lead:
        result += [
            Feature("lead", place, *scaling(definition.coordinates[index].sampling))
            for place, index in enumerate(leading(definition))
        ]
    result = [feature for place, feature in enumerate(result) if place not in feature_map.dropped]
    for place, rate in enumerate(feature_map.rates):
        if rate and result[place].function == "affine":
            result[place] = result[place]._replace(function="grown", rate=rate)
    return tuple(result)


def distances(definition: EnvironmentDefinition, a: Points, b: Points) -> Tensor:
    """Return the Euclidean distances (m, n) of m points ``a`` and n points ``b``, with each coordinate and action entry
    divided by its standard deviation over the sampling range."""
    plain = FeatureMap()
    return torch.cdist(encode(definition, plain, a.q, a.u), encode(definition, plain, b.q, b.u))


def encode(
    definition: EnvironmentDefinition, feature_map: FeatureMap, q: Tensor, u: Tensor, lead: Tensor | None = None
) -> Tensor:
    """Return the d features (..., d) of a feature map for coordinates q (..., C) and actions u (..., F).

    ``lead`` (..., L) are the next values of the L leading coordinates (see ``leading``), needed if the map reads them.
    """
    if (found := definition.encoders.get(feature_map)) is None:
        with torch.inference_mode(False):
            encoder = Encoder.of(definition, (feature_map,))
            places = torch.tensor(encoder.inputs(feature_map), dtype=torch.long, device=definition.device)
        found = definition.encoders[feature_map] = encoder, places
    encoder, places = found
    x = encoder(q, u)
    if feature_map.lead:
        assert lead is not None
        x = encoder.with_lead(x, lead)
    return x[..., places]


@dataclass(frozen=True)
class Encoder:
    """Encoder of coordinates and actions as the features of several maps. It computes a feature that several maps
    contain only once, and all features with the same function, such as cos, together."""

    definition: EnvironmentDefinition
    # One tuple for all features with the same function, such as cos: the function's name, the indices of the entries
    # that these features read (or weights of coordinates), then their centres, scales and rates.
    groups: tuple[tuple[str, slice | Tensor, Tensor, Tensor, Tensor], ...]
    columns: Mapping[Feature, int]

    @classmethod
    def of(cls, definition: EnvironmentDefinition, maps: Iterable[FeatureMap]) -> Encoder:
        """Build the encoder of some maps. It groups the features of all maps by their function, such as cos; features
        of the lead come last."""
        wanted = {feature for feature_map in maps for feature in features(definition, feature_map)}
        ordered = sorted(wanted, key=lambda f: (f.function == "lead", f))
        groups = tuple(
            (function, *_group(tuple(same), definition.device))
            for function, same in groupby(ordered, lambda f: f.function)
        )
        return cls(definition, groups, {feature: column for column, feature in enumerate(ordered)})

    def inputs(self, feature_map: FeatureMap) -> tuple[int, ...]:
        """Return in which columns of the encoder's result the features of one feature map are, in the map's order."""
        return tuple(self.columns[feature] for feature in features(self.definition, feature_map))

    def width(self, lead: bool) -> int:
        """Return the number of features, with or without those of the lead (the next values of leading coordinates)."""
        return sum(lead or feature.function != "lead" for feature in self.columns)

    def __call__(self, q: Tensor, u: Tensor) -> Tensor:
        """Return all d features (..., d) of coordinates q (..., C) and actions u (..., F), except those of the lead
        (the next values of leading coordinates)."""
        raw = torch.cat([q, u], -1)
        values = [self._values(*group, raw) for group in self.groups if group[0] != "lead"]
        return torch.cat(values, -1) if values else raw[..., :0]

    def with_lead(self, x: Tensor, lead: Tensor) -> Tensor:
        """Append the features of the lead (..., L), the next values of leading coordinates, to x (..., d), the result
        of calling the encoder."""
        return torch.cat([x, *(self._values(*group, lead) for group in self.groups if group[0] == "lead")], -1)

    def _values(
        self, function: str, entries: slice | Tensor, centre: Tensor, scale: Tensor, rate: Tensor, raw: Tensor
    ) -> Tensor:
        match function:
            case "observed":
                shown = self.definition.observe(raw[..., : len(self.definition.coordinates)])[..., entries]
                return (shown - centre) / scale
            case "cos":
                return raw[..., entries].cos()
            case "sin":
                return raw[..., entries].sin()
            case "turned_cos":
                return self._turned(entries, raw).cos()
            case "turned_sin":
                return self._turned(entries, raw).sin()
            case "wrapped":
                return wrap(raw[..., entries]) * (math.sqrt(3) / math.pi)
            case "equal":
                return (raw[..., entries] == centre).to(raw.dtype)
            case "grown":
                return bend((raw[..., entries] - centre) / scale, rate)
            case _:
                return (raw[..., entries] - centre) / scale

    def _turned(self, weights: slice | Tensor, raw: Tensor) -> Tensor:
        assert isinstance(weights, Tensor)
        return raw[..., : len(self.definition.coordinates)] @ weights


def _of_point(definition: EnvironmentDefinition, feature_map: FeatureMap) -> list[Feature]:
    """Return the features of coordinates and action in a feature map, without those of the lead (next values of leading
    coordinates), and before any is dropped."""
    result: list[Feature] = []
    if feature_map.state == "observation":
        result += _of_observation(definition)
    else:
        for index in _read(definition, feature_map):
            result += _of_coordinate(definition, feature_map, index)
    for index, weights in zip(definition.angles, feature_map.drift, strict=False):
        turned = tuple(w + (i == index) for i, w in enumerate(weights))
        result += [Feature("turned_cos", index, weights=turned), Feature("turned_sin", index, weights=turned)]
    for entry in range(definition.action.size if feature_map.action != "none" else 0):
        result += _of_action(definition, feature_map, entry)
    return result


def _read(definition: EnvironmentDefinition, feature_map: FeatureMap) -> Iterator[int]:
    """Yield the indices of the coordinates that are inputs in a feature map: not the counter of steps, and no lag that
    looks back further than the map's ``history``."""
    for index, age in enumerate(definition.ages):
        if index != definition.counter and (feature_map.history is None or age <= feature_map.history):
            yield index


def _of_observation(definition: EnvironmentDefinition) -> list[Feature]:
    if definition.moves_observation:
        return [Feature("observed", entry) for entry in range(len(definition.observation_names))]
    centres, scales = (values.tolist() for values in definition.observation_scaling)
    return [Feature("observed", entry, *scaling) for entry, scaling in enumerate(zip(centres, scales, strict=True))]


def _of_coordinate(definition: EnvironmentDefinition, feature_map: FeatureMap, index: int) -> list[Feature]:
    coordinate = definition.coordinates[index]
    if coordinate.kind != "angle":
        return [Feature("affine", index, *scaling(coordinate.sampling))]
    circle = [Feature("cos", index), Feature("sin", index)] if feature_map.state in ("cos_sin", "both") else []
    return circle + ([Feature("wrapped", index)] if feature_map.state in ("wrapped", "both") else [])


def _of_action(definition: EnvironmentDefinition, feature_map: FeatureMap, entry: int) -> list[Feature]:
    action, place = definition.action, len(definition.coordinates) + entry
    if not action.nvec:
        low, high = action.ranges[entry]
        return [Feature("affine", place, (low + high) / 2, (high - low) / math.sqrt(12))]
    count = action.nvec[entry]
    if feature_map.action == "one_hot" and count > 2:
        return [Feature("equal", place, float(value)) for value in range(count)]
    return [Feature("affine", place, (count - 1) / 2, math.sqrt((count**2 - 1) / 12))]


def _group(same: tuple[Feature, ...], device: torch.device) -> tuple[slice | Tensor, Tensor, Tensor, Tensor]:
    """Return the parameters of k features with the same function, such as cos: the indices of the entries that they
    read (a slice if the indices are consecutive) or weights (C, k); then their centres (k,), scales (k,) and rates
    (k,)."""
    numbers = torch.tensor([(f.centre, f.scale, f.rate) for f in same], dtype=torch.float64, device=device)
    centre, scale, rate = numbers.T
    if same[0].weights:
        return torch.tensor([f.weights for f in same], dtype=torch.float64, device=device).T, centre, scale, rate
    entries = [feature.entry for feature in same]
    neighbours = entries == list(range(entries[0], entries[0] + len(entries)))
    index = slice(entries[0], entries[-1] + 1) if neighbours else torch.tensor(entries, device=device)
    return index, centre, scale, rate
