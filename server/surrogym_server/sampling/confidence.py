"""Confidence of a model over a Monte Carlo set: eq. 8 to 10, with a tolerance tau for each output.

The certainty at a point is C_m = Phi(tau / sigma). The paper has tau = 1 in the output's unit, so its C_m depends on
the unit. The model uncertainty U_m = 1 - C_m is kept as a logarithm, because it rounds to 0 if sigma is below tau / 8.
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
from surrogym_server.sampling.regions import Region, regions_of

SUREST = 1e9  # the ratio of tolerance to standard deviation is at most this, so that log U_m is finite


@dataclass(frozen=True)
class OutputConfidence:
    """How well a model knows one output (confidence index, prediction errors), and what limits it, such as noise."""

    confidence_index: float  # mean certainty C_m over the Monte Carlo set (eq. 8)
    confidence_index_paper: float  # the confidence index with a tolerance of 1 in the output's unit, as in the paper
    coverage: float  # share of the Monte Carlo set where the standard deviation is at most the tolerance
    # Root mean square leave-one-out error, in the output's unit; None if the model family does not compute it.
    leave_one_out_error: float | None
    leave_one_out_within_one: float | None  # share of leave-one-out errors up to one predictive standard deviation
    leave_one_out_within_two: float | None  # share of leave-one-out errors up to two predictive standard deviations
    # Standard deviation of one step's noise, in the output's unit; 0 unless repeated or consecutive steps confirm it.
    noise: float = 0.0
    # Standard deviation of one measurement by the sensor; 0 unless most of the noise comes from the sensor.
    sensor_noise: float = 0.0
    # Share of the model's squared errors that earlier steps of the episode explain, as with a dead time.
    past: float = 0.0
    region: Region | None = None  # part of the sampling range in which most of the model uncertainty lies


def stds(model: DynamicsModel, q: Tensor, u: Tensor) -> Tensor:
    """Return the standard deviations (m, O), without noise, of the O outputs at states q (m, C) and actions u (m, F).
    The last output is the reward."""
    transition = model.transition(q, u, stds=True, reward_std=True)
    require_shapes(model, transition, q, stds=True)
    assert transition.std is not None
    assert transition.reward_std is not None
    return torch.cat([transition.std, transition.reward_std[:, None]], -1)


def certainty(std: Tensor, tolerance: Tensor | float) -> Tensor:
    """Return the certainty C_m = Phi(tau / sigma) (eq. 9) for standard deviations sigma = ``std``, of any shape, and
    tolerances tau = ``tolerance``; 1 if sigma is 0."""
    index: Tensor = torch.special.ndtr(tolerance / std)
    return index


def log_model_uncertainty(std: Tensor, tolerance: Tensor | float) -> Tensor:
    """Return the logarithm of the model uncertainty (eq. 10), log U_m = log Phi(-tau / sigma), for standard deviations
    sigma = ``std``, of any shape, and tolerances tau = ``tolerance``. It is finite also if sigma is 0."""
    log_uncertainty: Tensor = torch.special.log_ndtr(-(tolerance / std).clamp_max(SUREST))
    return log_uncertainty


def log_uncertainty_index(log_model_uncertainty: Tensor, log_probability: Tensor) -> Tensor:
    """Return the logarithm of the paper's uncertainty index U (eq. 12), from the logarithms of the model uncertainty
    U_m and the input probability P_i."""
    return log_model_uncertainty + log_probability


def confidences_of(
    model: DynamicsModel, points: Points, std: Tensor, tolerances: Sequence[float]
) -> list[OutputConfidence]:
    """Return the confidence of every output (O,), from their standard deviations ``std`` (m, O) at the m points of the
    Monte Carlo set."""
    able = offers(model, LeaveOneOut)
    errors = [None] * len(tolerances) if able is None else able.leave_one_out()
    doubt = log_model_uncertainty(std, std.new_tensor(tolerances)).exp()
    regions = regions_of(model.definition, points, doubt)
    confidences = [confidence(std[:, i], tolerances[i], errors[i]) for i in range(len(tolerances))]
    return [replace(one, region=region) for one, region in zip(confidences, regions, strict=True)]


def confidence(std: Tensor, tolerance: float, errors: LeaveOneOutErrors | None) -> OutputConfidence:
    """Return the confidence of one output, from its standard deviations (m,) at the m points of the Monte Carlo set,
    its tolerance, and its leave-one-out errors (None if unknown)."""
    return OutputConfidence(
        float(certainty(std, tolerance).mean()),
        float(certainty(std, 1.0).mean()),
        float((std <= tolerance).double().mean()),
        *((None, None, None) if errors is None else (errors.error, errors.within_one, errors.within_two)),
    )
