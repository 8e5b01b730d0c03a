"""Unwrapping of angles that move by more than half a turn within one step.

If an angle moves by more than half a turn in a step, its wrapped increment is wrong by full turns, and jumps as a
function of the speed. No smooth function predicts such jumps. The true increment is close to linear in the speeds, so
the missing turns are those that make it linear: linear regression on a circle (Fisher & Lee, Biometrics 48, 1992).
"""

from __future__ import annotations

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition, wrap
from surrogym_server.environment.distributions import scaling

# Full turns are added to an angle's increments only if there are this many steps for each weight of the regression of
# the increments on the speeds.
POINTS_A_WEIGHT = 3
# The search for full turns starts from linear functions of a speed that reach up to this many turns in a step.
MAX_TURNS = 3
# For each full turn in a step, the search starts from this many positive slopes of the linear function, and as many
# negative ones.
STARTS_A_TURN = 8
# Number of iterations of the search from each start; each chooses the full turns and fits a linear function.
ROUNDS = 10
# Full turns are added to an angle's increments only if they reduce the sum of squared residuals of the regression to
# less than this share.
CLEARLY = 0.25


def angle_increments(definition: EnvironmentDefinition, q: Tensor, q_next: Tensor) -> Tensor:
    """Return the increments in radians, (n, A), of the A angles among the coordinates, in n steps from q (n, C) to
    q_next (n, C). An increment includes the full turns that the angle makes within the step."""
    change = wrap((q_next - q)[:, definition.angles])
    moved_by = [i for i in definition.moving if definition.coordinates[i].kind == "linear"]
    if not moved_by or len(q) < POINTS_A_WEIGHT * (len(moved_by) + 1):
        return change
    centre, scale = torch.tensor([scaling(definition.coordinates[i].sampling) for i in moved_by], dtype=torch.float64).T
    speeds = ((q + q_next)[:, moved_by] / 2 - centre) / scale
    return torch.stack([_unwrapped(speeds, column) for column in change.T], -1) if change.numel() else change


def _unwrapped(speeds: Tensor, change: Tensor) -> Tensor:
    """Add full turns to the increments of an angle (n,), so that they come as close as possible to a linear function of
    the speeds (n, L). Return the increments unchanged if this does not clearly reduce the residuals.

    The search has many starts: each assumes a slope over one speed, up to the slope that explains ``MAX_TURNS`` turns
    in a step. From each start it alternates: it chooses the turns that come closest to the linear function, then fits
    the function by least squares. The result with the smallest residuals is used.
    """
    basis = torch.cat([torch.ones(len(speeds), 1, dtype=torch.float64), speeds], 1)
    solve = torch.linalg.pinv(basis)
    plain = change - basis @ (solve @ change)
    steepest = 2 * torch.pi * MAX_TURNS / speeds.abs().amax(0).clamp_min(1e-12)
    slopes = torch.linspace(-1, 1, 2 * MAX_TURNS * STARTS_A_TURN + 1, dtype=torch.float64)
    weights = torch.cat(
        [slopes.new_zeros(len(slopes) * speeds.shape[1], 1), torch.kron(slopes[:, None], steepest.diag())], 1
    )
    fitted = basis @ weights.T
    for _ in range(ROUNDS):
        whole = change[:, None] + 2 * torch.pi * ((fitted - change[:, None]) / (2 * torch.pi)).round()
        fitted = basis @ (solve @ whole)
    residual = (whole - fitted).square().sum(0)
    best = int(residual.argmin())
    return whole[:, best] if float(residual[best]) < CLEARLY * float(plain.square().sum()) else change
