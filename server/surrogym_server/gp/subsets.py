"""Subsets of many points to fit hyperparameters to, so that no fit takes time in the third power of n.

A fit evaluates the evidence some hundred times, each time in O(n^3). So with more than ``FEW`` points, alternatives are
compared on ``FEW`` of them. The chosen one is fitted to ``SOME`` points, then refined on more, near the optimum and in
few evaluations (``gp.fit.REFINEMENTS``). The process is conditioned on all points.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

FEW, SOME = 150, 400  # numbers of points: to compare alternatives, and to fit the chosen one
SEED = 0


def spread(points: int, most: int) -> Tensor:
    """Select at most ``most`` of the points, as ascending indices (m,).

    All are selected if there are no more than ``most``. Otherwise the sequence is cut into ``most`` equal stretches,
    and a fixed seed draws one point of each: points at equal distances could sample one phase of a periodic sequence.
    """
    if points <= most:
        return torch.arange(points)
    edges = np.linspace(0, points, most + 1).astype(np.int64)
    return torch.from_numpy(np.random.default_rng(SEED).integers(edges[:-1], edges[1:]))
