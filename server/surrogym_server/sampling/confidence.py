"""Confidence of a model over a Monte Carlo set: eq. 8 to 10, with a tolerance tau for each output.

C_m = Phi(tau / sigma). The paper has tau = 1 in the output's raw unit, so its value depends on units. U_m = 1 - C_m is
kept as a logarithm, because the difference rounds to 0 if sigma is below tau / 8.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from surrogym_server.environment.points import Points
from surrogym_server.models.abilities import LeaveOneOut, LeaveOneOutErrors, offers
from surrogym_server.models.guard import require_shapes
from surrogym_server.models.port import DynamicsModel
from surrogym_server.sampling.prequential import PrequentialScores
from surrogym_server.sampling.regions import Region, regions_of

SUREST = 1e9  # largest ratio of tolerance to standard deviation; larger ones are clipped to it


@dataclass(frozen=True)
class OutputConfidence:
    confidence_index: float
    confidence_index_paper: float
    coverage: float  # share of the set whose standard deviation is below the tolerance
    leave_one_out_error: float | None  # root mean square, in the output's unit; None where the family can't tell
    leave_one_out_within_one: float | None  # share of the samples within one predictive standard deviation
    leave_one_out_within_two: float | None
    noise: float = 0.0  # of a single step, established by repeated or by consecutive steps, in the output's unit
    sensor_noise: float = 0.0  # standard deviation of one measurement, if most of the noise is the sensor's
    past: float = 0.0  # share of the squared residuals that the step before explains: a dead time or a hidden state
    region: Region | None = None  # where most of the doubt is
    prequential: PrequentialScores | None = None  # of samples that were predicted before they were learned from


def deviations(model: DynamicsModel, q: Tensor, u: Tensor) -> Tensor:
    """Latent standard deviation of every output, the reward last, at q (m, C) and u (m, F): (m, O)."""
    transition = model.transition(q, u, deviations=True, reward_deviation=True)
    require_shapes(model, transition, q, deviations=True)
    assert transition.deviation is not None
    assert transition.reward_deviation is not None
    return torch.cat([transition.deviation, transition.reward_deviation[:, None]], -1)


def certainty(deviation: Tensor, tolerance: Tensor | float) -> Tensor:
    """C_m (eq. 9). A standard deviation of 0 is certain."""
    index: Tensor = torch.special.ndtr(tolerance / deviation)
    return index


def log_model_uncertainty(deviation: Tensor, tolerance: Tensor | float) -> Tensor:
    """log U_m (eq. 10) = log Phi(-tau / sigma), finite where sigma is 0 as well."""
    log_uncertainty: Tensor = torch.special.log_ndtr(-(tolerance / deviation).clamp_max(SUREST))
    return log_uncertainty


def log_uncertainty_index(log_model_uncertainty: Tensor, log_probability: Tensor) -> Tensor:
    """log U, the uncertainty index of the paper."""
    return log_model_uncertainty + log_probability  # eq. 12


def confidences_of(
    model: DynamicsModel, points: Points, deviation: Tensor, tolerances: Sequence[float]
) -> list[OutputConfidence]:
    """Confidence of every output (O,) from its standard deviations (m, O) over the points of the Monte Carlo set."""
    able = offers(model, LeaveOneOut)
    errors = [None] * len(tolerances) if able is None else able.leave_one_out()
    doubt = log_model_uncertainty(deviation, deviation.new_tensor(tolerances)).exp()
    regions = regions_of(model.definition, points, doubt)
    confidences = [confidence(deviation[:, i], tolerances[i], errors[i]) for i in range(len(tolerances))]
    return [replace(one, region=region) for one, region in zip(confidences, regions, strict=True)]


def confidence(deviation: Tensor, tolerance: float, errors: LeaveOneOutErrors | None) -> OutputConfidence:
    """Confidence of one output: from its standard deviations (m,) over the Monte Carlo set and leave-one-out errors."""
    return OutputConfidence(
        float(certainty(deviation, tolerance).mean()),
        float(certainty(deviation, 1.0).mean()),
        float((deviation <= tolerance).double().mean()),
        *((None, None, None) if errors is None else (errors.error, errors.within_one, errors.within_two)),
    )
