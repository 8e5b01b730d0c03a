"""Subsets of n points to which hyperparameters are fitted, because a fit to all would take time proportional to n^3.

A fit evaluates the evidence some hundred times, each time in O(n^3). So with more than ``FEW`` points, alternatives are
compared on ``FEW`` of them. The chosen one is fitted to ``SOME`` points, then refined on more, near the optimum and in
few evaluations (``gp.fit.REFINEMENTS``). The process is conditioned on all points.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

# A process is fitted to at most ``FEW`` points to compare alternatives, and to at most ``SOME`` for the one chosen.
FEW, SOME = 150, 400
SEED = 0


def spread(points: int, most: int) -> Tensor:
    """Select at most ``most`` of ``points`` points. Return the ascending indices (m,) of the m selected points.

    If there are no more than ``most`` points, all are selected. Otherwise the sequence of points is cut into ``most``
    equal parts, and one random point of each part is selected, always with the same seed. They are random, because
    points at equal distances could all lie at one phase of a periodic sequence.
    """
    if points <= most:
        return torch.arange(points)
    edges = np.linspace(0, points, most + 1).astype(np.int64)
    return torch.from_numpy(np.random.default_rng(SEED).integers(edges[:-1], edges[1:]))
