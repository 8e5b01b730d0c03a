"""Which of many points hyperparameters are fitted to, so that no fit grows with the third power of n.

A fit of n points evaluates the evidence some hundred times, each in O(n^3). So beyond ``FEW`` points alternatives are
compared on ``FEW`` of them. What was chosen is fitted to ``SOME``, then, near the optimum and in few evaluations, to
more (``gp.fit.REFINEMENTS``). The process is conditioned on all.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

FEW, SOME = 150, 400  # points
SEED = 0


def spread(points: int, most: int) -> Tensor:
    """Which of n points in the order they came: all up to ``most``, else one from each of ``most`` equal stretches,
    (m,). Drawn within the stretch by a fixed seed: equal distances would see one phase of what repeats."""
    if points <= most:
        return torch.arange(points)
    edges = np.linspace(0, points, most + 1).astype(np.int64)
    return torch.from_numpy(np.random.default_rng(SEED).integers(edges[:-1], edges[1:]))
