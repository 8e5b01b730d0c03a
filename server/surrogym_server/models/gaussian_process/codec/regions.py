"""Conversion of a learned region of states to header and tensors, and back, with a check of every number."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.errors import InvalidInput
from surrogym_server.models.gaussian_process.codec.outputs import (
    output_header,
    output_tensors,
    read_output,
    require_output,
)
from surrogym_server.models.gaussian_process.prediction.regions import (
    Axes,
    Classifier,
    Cut,
    Form,
    Jump,
    Region,
    Thresholds,
)


def region_header(region: Region) -> dict[str, Any]:
    """Return all fields of a region except its arrays, as values for JSON."""
    return {"forms": [[weight, _form_header(form)] for weight, form in region.forms], "scores": region.scores}


def region_tensors(region: Region, prefix: str) -> dict[str, Tensor]:
    """Return the arrays of a region by name. Each name begins with ``prefix``."""
    tensors: dict[str, Tensor] = {}
    for index, (_, form) in enumerate(region.forms):
        if isinstance(form, Classifier):
            tensors |= output_tensors(form.process, f"{prefix}.{index}")
    return tensors


def read_region(
    definition: EnvironmentDefinition, entry: Any, tensors: Mapping[str, Tensor], prefix: str
) -> Region | None:
    """Build a region from its entry in the header and its arrays, whose names in ``tensors`` begin with ``prefix``.
    Return None if ``entry`` is None.

    Raises:
        LookupError, TypeError, ValueError: the entry is malformed.
    """
    if entry is None:
        return None
    forms = tuple(
        (float(weight), _read_form(definition, form, tensors, f"{prefix}.{index}"))
        for index, (weight, form) in enumerate(entry["forms"])
    )
    return Region(forms, tuple((str(name), float(score)) for name, score in entry["scores"]))


def read_jumps(
    definition: EnvironmentDefinition, entries: Any, tensors: Mapping[str, Tensor], prefix: str
) -> tuple[Jump, ...]:
    """Build the jumps of a reward from their entries in the header and their arrays, whose names in ``tensors`` begin
    with ``prefix``.

    Raises:
        LookupError, TypeError, ValueError: an entry is malformed.
    """
    jumps = []
    for index, (size, entry) in enumerate(entries):
        region = read_region(definition, entry, tensors, f"{prefix}.{index}")
        if region is None:
            raise ValueError(
                f"expected a region of states for jump {index} of the reward, got none; export the model again"
            )
        jumps.append(Jump(region, float(size)))
    return tuple(jumps)


def require_region(region: Region) -> None:
    """Raise ``InvalidInput`` unless a region's weights, processes and thresholds are valid."""
    weights = [weight for weight, _ in region.forms]
    if not weights or min(weights) <= 0 or not math.isclose(sum(weights), 1, abs_tol=1e-6):
        raise InvalidInput(
            "expected a learned region of states whose parts have weights above 0 that add up to 1, got the weights "
            f"{weights[:4]}; export the model again"
        )
    for _, form in region.forms:
        if isinstance(form, Classifier):
            _require_classifier(form)
        else:
            _require_thresholds(form)


def _form_header(form: Form) -> dict[str, Any]:
    match form:
        case Thresholds(rules=rules, complement=complement):
            return {"rules": [[list(vars(cut).values()) for cut in rule] for rule in rules], "complement": complement}
        case Classifier(process=process):
            return {"process": output_header(process)}


def _read_form(definition: EnvironmentDefinition, entry: Any, tensors: Mapping[str, Tensor], prefix: str) -> Form:
    if "process" in entry:
        return Classifier(definition, read_output(definition, entry["process"], tensors, prefix))
    rules = tuple(tuple(_cut(*cut) for cut in rule) for rule in entry["rules"])
    return Thresholds(definition, rules, bool(entry["complement"]))


def _require_classifier(classifier: Classifier) -> None:
    if classifier.process.feature_map.lead:
        raise InvalidInput(
            "expected a learned region of states whose classifier reads the state alone, got a classifier that also "
            "reads next values (`lead`); export the model again"
        )
    require_output(classifier.definition, classifier.process)


def _require_thresholds(thresholds: Thresholds) -> None:
    axes = len(Axes.of(thresholds.definition))
    cuts = [cut for rule in thresholds.rules for cut in rule]
    sound = all(
        0 <= cut.axis < axes
        and math.isfinite(cut.outside)
        and math.isfinite(cut.inside)
        and cut.outside < cut.inside
        and 0 < cut.weight <= 1
        for cut in cuts
    )
    if not (sound and thresholds.rules and all(thresholds.rules)):
        raise InvalidInput(
            f"expected a learned region of states with thresholds on the axes 0 to {axes - 1}, each with outside < "
            f"inside and a weight above 0 and at most 1, got {cuts[:4]}; export the model again"
        )


def _cut(axis: Any, outside: Any, inside: Any, weight: Any) -> Cut:
    return Cut(int(axis), float(outside), float(inside), float(weight))
