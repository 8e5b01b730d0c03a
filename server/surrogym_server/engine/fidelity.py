"""Fidelity of a model that came from elsewhere: the same figures that a round of the design gives its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from surrogym_server.sampling.confidence import confidence, deviations
from surrogym_server.sampling.design import TOLERANCE, monte_carlo
from surrogym_server.surrogate.model import SurrogateModel


def fidelity_of(model: SurrogateModel, tolerances: Sequence[float], target: float) -> dict[str, Any]:
    """The fields of ``wire.Fidelity``.

    Args:
        model: any model of the surrogate.
        tolerances: (O,) frozen by the design; empty before its first round, and then taken from the spec and
            the model's own scales.
        target: confidence index the design aims at.
    """
    outputs = (*model.transitions, model.reward)
    if not tolerances:
        declared = dict(model.definition.tolerances)
        tolerances = [declared.get(output.name, TOLERANCE * output.scale) for output in outputs]
    deviation = deviations(model, *monte_carlo(model.definition))
    rows = []
    for index, (output, tolerance) in enumerate(zip(outputs, tolerances, strict=True)):
        judged = confidence(output, deviation[:, index], tolerance)
        rows.append(
            {
                "name": output.name,
                "structure": str(output.feature_map),
                "tolerance": tolerance,
                **asdict(judged),
            }
        )
    return {
        "confidence_index": min(row["confidence_index"] for row in rows),
        "confidence_index_paper": min(row["confidence_index_paper"] for row in rows),
        "target": target,
        "samples": model.samples,
        "outputs": rows,
    }
