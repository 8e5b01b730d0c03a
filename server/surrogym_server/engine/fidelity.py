"""Fidelity of a model as JSON: of the one a round of the design has just fitted, or of one that came from elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from surrogym_server.models.gaussian_process.prediction.model import GaussianProcessModel
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel
from surrogym_server.sampling.confidence import OutputConfidence, confidence, deviations
from surrogym_server.sampling.design import monte_carlo, usual_tolerances


def fidelity_fields(
    model: GaussianProcessModel, confidences: Sequence[OutputConfidence], tolerances: Sequence[float], target: float
) -> dict[str, Any]:
    """The fields of ``wire.Fidelity``, from the confidence and tolerance of each output, (O,) each."""
    rows = [
        {"name": output.name, "structure": _structure(output), "tolerance": tolerance, **asdict(judged)}
        for output, judged, tolerance in zip(_outputs(model), confidences, tolerances, strict=True)
    ]
    return {
        "confidence_index": min(c.confidence_index for c in confidences),
        "confidence_index_paper": min(c.confidence_index_paper for c in confidences),
        "target": target,
        "samples": model.samples,
        "outputs": rows,
    }


def fidelity_of(model: GaussianProcessModel, usual: Sequence[float], target: float) -> dict[str, Any]:
    """The fields of ``wire.Fidelity`` of any model of the surrogate.

    Args:
        model: what to judge.
        usual: (O,) tolerances frozen by the design, over which those of the definition go; empty before its first
            round, and then taken from the model's own scales.
        target: confidence index the design aims at.
    """
    outputs = _outputs(model)
    usual = usual or usual_tolerances(model.definition, [output.scale for output in outputs])
    tolerances = model.definition.tolerances_over(usual)
    deviation = deviations(model, *monte_carlo(model.definition))
    confidences = [confidence(o, deviation[:, i], t) for i, (o, t) in enumerate(zip(outputs, tolerances, strict=True))]
    return fidelity_fields(model, confidences, tolerances, target)


def _outputs(model: GaussianProcessModel) -> tuple[OutputModel, ...]:
    return (*model.transitions, model.reward)


def _structure(output: OutputModel) -> str:
    if output.posterior is None:
        return "constant"
    return f"{output.posterior.hyper.kernel} on {output.feature_map}"
