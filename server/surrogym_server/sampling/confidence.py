"""Confidence of a model over a Monte Carlo set: eq. 8 to 10, with a tolerance tau for each output.

C_m = Phi(tau / sigma); tau = 1 in the output's raw unit is the paper's, which depends on units. U_m = 1 - C_m is kept
as a logarithm: written as a difference it cancels to 0 below sigma = tau / 8.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from surrogym_server.surrogate.model import OutputModel, SurrogateModel


@dataclass(frozen=True)
class OutputConfidence:
    confidence_index: float
    confidence_index_paper: float
    coverage: float  # share of the set whose deviation is below the tolerance
    leave_one_out_error: float  # root mean square, in the output's unit


def deviations(model: SurrogateModel, q: Tensor, u: Tensor) -> Tensor:
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
    """log U_m (eq. 10) = log Phi(-tau / sigma)."""
    log_uncertainty: Tensor = torch.special.log_ndtr(-tolerance / deviation)
    return log_uncertainty


def confidence(output: OutputModel, deviation: Tensor, tolerance: float) -> OutputConfidence:
    """Confidence of one output from its deviations (m,) over the Monte Carlo set."""
    return OutputConfidence(
        float(certainty(deviation, tolerance).mean()),
        float(certainty(deviation, 1.0).mean()),
        float((deviation <= tolerance).double().mean()),
        leave_one_out_error(output),
    )


def leave_one_out_error(output: OutputModel) -> float:
    """Root mean square of the leave-one-out errors, in the output's unit; 0 for an output that never varied."""
    if output.posterior is None:
        return 0.0
    mean, _ = output.posterior.leave_one_out()
    return float(output.scale * (mean - output.posterior.y).square().mean().sqrt())
