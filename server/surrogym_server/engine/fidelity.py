"""Fidelity of a model (confidence index, tolerances, errors) as JSON, for fitted and for imported models."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from surrogym_server.environment.points import Points
from surrogym_server.models.port import DynamicsModel
from surrogym_server.sampling.confidence import OutputConfidence, confidences_of, stds
from surrogym_server.sampling.judging import monte_carlo
from surrogym_server.sampling.limits import Limit
from surrogym_server.sampling.tolerances import default_tolerances


def fidelity_fields(
    model: DynamicsModel,
    confidences: Sequence[OutputConfidence],
    tolerances: Sequence[float],
    target: float,
    limits: Sequence[Limit] = (),
) -> dict[str, Any]:
    """Return the fields of ``wire.Fidelity`` for a model.

    Args:
        model: the model.
        confidences: (O,) confidence of each output.
        tolerances: (O,) tolerance of each output, in its unit.
        target: confidence index that the design aims at.
        limits: ends of coordinates' ranges that samples have reached.
    """
    rows = [
        {"name": name, "structure": structure, "tolerance": tolerance, **asdict(output)}
        for name, structure, output, tolerance in zip(
            model.definition.outputs, model.structures, confidences, tolerances, strict=True
        )
    ]
    return {
        "confidence_index": min(c.confidence_index for c in confidences),
        "confidence_index_paper": min(c.confidence_index_paper for c in confidences),
        "target": target,
        "samples": model.samples,
        "outputs": rows,
        "limits": [asdict(limit) for limit in limits],
    }


def fidelity_of(model: DynamicsModel, defaults: Sequence[float], target: float) -> dict[str, Any]:
    """Compute the confidence of a model, and return the fields of ``wire.Fidelity``.

    Args:
        model: the model.
        defaults: (O,) tolerances for outputs without a declared one. If empty, as before the first round of a design,
            they are computed from the scales of the model's outputs.
        target: confidence index that the design aims at.
    """
    defaults = defaults or default_tolerances(model.definition, model.scales.tolist())
    tolerances = model.definition.tolerances_or(defaults)
    points = Points(*monte_carlo(model.definition))
    confidences = confidences_of(model, points, stds(model, points.q, points.u), tolerances)
    return fidelity_fields(model, confidences, tolerances, target)
