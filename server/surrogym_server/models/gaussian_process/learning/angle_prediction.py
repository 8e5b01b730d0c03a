"""Drift: the change of an angle within a step by its present motion, predicted by a linear regression.

A fast pole turns far within a step. The forces on it depend on all angles on the way, not only on the first angle. So
cosine and sine of angle + drift are better inputs than those of the angle alone.
"""

from __future__ import annotations

import torch

from surrogym_server.environment.angle_unwrapping import angle_increments
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.distributions import scaling
from surrogym_server.environment.features import Drift
from surrogym_server.environment.samples import Samples

# The regression that predicts an angle's change needs at least this many samples for each of its weights.
POINTS_A_WEIGHT = 3


def learn_drift(definition: EnvironmentDefinition, samples: Samples) -> Drift:
    """Fit, for each angle, weights w (C,) of the coordinates q that predict the angle's increment as w . q + constant,
    by least squares. Return the weights without the constant.

    Angles and past actions among the coordinates have the weight 0. The result is () if there is no angle or if there
    are too few samples.
    """
    moved_by = [
        i
        for i, c in enumerate(definition.coordinates)
        if c.kind == "linear" and (c.lag is None or c.lag.kind != "action")
    ]
    if not definition.angles or not moved_by or len(samples) < POINTS_A_WEIGHT * (len(moved_by) + 1):
        return ()
    centre, scale = torch.tensor([scaling(definition.coordinates[i].sampling) for i in moved_by], dtype=torch.float64).T
    basis = torch.cat([torch.ones(len(samples), 1, dtype=torch.float64), (samples.q[:, moved_by] - centre) / scale], 1)
    change = angle_increments(definition, samples.q, samples.q_next)
    coefficients = torch.linalg.lstsq(basis, change, driver="gelsd").solution
    weights = torch.zeros(len(definition.angles), len(definition.coordinates), dtype=torch.float64)
    weights[:, moved_by] = coefficients[1:].T / scale
    return tuple(tuple(row) for row in weights.tolist())
