"""Confidence of a model over a Monte Carlo set: eq. 8 to 10, with a tolerance tau for each output.

C_m = Phi(tau / sigma); tau = 1 in the output's raw unit is the paper's, which depends on units. U_m = 1 - C_m is kept
as a logarithm: written as a difference it cancels to 0 below sigma = tau / 8.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from surrogym_server.models.gaussian_process.prediction.model import GaussianProcessModel
from surrogym_server.models.gaussian_process.prediction.output_model import OutputModel

SUREST = 1e9  # tolerances over a deviation: what is known better counts as known so well


@dataclass(frozen=True)
class OutputConfidence:
    confidence_index: float
    confidence_index_paper: float
    coverage: float  # share of the set whose deviation is below the tolerance
    leave_one_out_error: float  # root mean square, in the output's unit
    leave_one_out_within_one: float  # share of the samples within one predictive deviation: 0.68 if it tells the truth
    leave_one_out_within_two: float  # 0.95


def deviations(model: GaussianProcessModel, q: Tensor, u: Tensor) -> Tensor:
    """Latent deviation of every output, the reward last, at q (m, C) and u (m, F): (m, O)."""
    transition = model.transition(q, u, deviations=True, reward_deviation=True)
    assert transition.deviation is not None
    assert transition.reward_deviation is not None
    return torch.cat([transition.deviation, transition.reward_deviation[:, None]], -1)


def certainty(deviation: Tensor, tolerance: Tensor | float) -> Tensor:
    """C_m (eq. 9). A deviation of 0 is certain."""
    index: Tensor = torch.special.ndtr(tolerance / deviation)
    return index


def log_model_uncertainty(deviation: Tensor, tolerance: Tensor | float) -> Tensor:
    """log U_m (eq. 10) = log Phi(-tau / sigma), finite where sigma is 0 as well."""
    log_uncertainty: Tensor = torch.special.log_ndtr(-(tolerance / deviation).clamp_max(SUREST))
    return log_uncertainty


def confidence(output: OutputModel, deviation: Tensor, tolerance: float) -> OutputConfidence:
    """Confidence of one output from its deviations (m,) over the Monte Carlo set."""
    return OutputConfidence(
        float(certainty(deviation, tolerance).mean()),
        float(certainty(deviation, 1.0).mean()),
        float((deviation <= tolerance).double().mean()),
        *leave_one_out(output),
    )


def leave_one_out(output: OutputModel) -> tuple[float, float, float]:
    """Root mean square of the leave-one-out errors, in the output's unit, and which share of them lies within one and
    within two of the deviations predicted for them. An output that never varied makes no error."""
    if output.posterior is None:
        return 0.0, 1.0, 1.0
    mean, variance = output.posterior.leave_one_out()
    error, deviation = (mean - output.posterior.y).abs(), variance.sqrt()
    one, two = (float((error <= width * deviation).double().mean()) for width in (1, 2))
    return float(output.scale * error.square().mean().sqrt()), one, two
