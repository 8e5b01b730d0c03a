"""Latin hypercube over the joint state-action space (section 3.2): equally probable intervals, one point in each."""

from __future__ import annotations

import numpy as np
import scipy  # scipy loads its parts on first use, so a server that needs none starts sooner
import torch
from numpy.typing import NDArray
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition

Array = NDArray[np.float64]
REDRAWS = 100  # greatest number of times that points in terminated states are drawn again


def latin_hypercube(
    definition: EnvironmentDefinition, count: int, rng: np.random.Generator, tries: int = 1
) -> tuple[Tensor, Tensor]:
    """Draw a Latin hypercube of ``count`` points: coordinates (count, C) and actions (count, F).

    Each coordinate is stratified in probability, so truncated distributions keep their shape. Discrete actions are
    balanced: the counts of two of them differ by at most one. Of ``tries`` random hypercubes, the one whose closest
    pair of points is farthest apart is returned.
    """
    dimensions = len(definition.coordinates) + definition.action.size
    designs = [_unit_hypercube(count, dimensions, rng, definition.action.nvec) for _ in range(tries)]
    best = max(designs, key=_closest_pair) if tries > 1 and count > 1 else designs[0]
    return from_unit(definition, torch.from_numpy(best))


def random_points(definition: EnvironmentDefinition, count: int, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Draw independent points from the sampling distributions: coordinates (count, C) and actions (count, F)."""
    dimensions = len(definition.coordinates) + definition.action.size
    return from_unit(definition, torch.from_numpy(rng.random((count, dimensions))))


def going_on(
    definition: EnvironmentDefinition, q: Tensor, u: Tensor, rng: np.random.Generator
) -> tuple[Tensor, Tensor]:
    """Replace those of the points q (n, C), u (n, F) at which the declared termination holds, or that lie within the
    margin of a limit, by random other points.

    No episode passes through a terminated state, so a query there would teach nothing, and the sampler refuses one
    within a margin. If there is no other point in the whole range, the points stay.
    """
    q, u = q.clone(), u.clone()
    for _ in range(REDRAWS):
        over = definition.terminated(q) | definition.falls_back(q, q)
        if not bool(over.any()):
            break
        q[over], u[over] = random_points(definition, int(over.sum()), rng)
    return q, u


def from_unit(definition: EnvironmentDefinition, p: Tensor) -> tuple[Tensor, Tensor]:
    """Map probabilities p (n, C + F) in [0, 1) to coordinates (n, C) and actions (n, F) of the sampling
    distributions."""
    size = len(definition.coordinates)
    q = torch.stack([c.sampling.quantile(p[:, i]) for i, c in enumerate(definition.coordinates)], -1)
    action, u = definition.action, p[:, size:]
    if action.nvec:
        return q, torch.floor(u * torch.tensor(action.nvec, dtype=p.dtype))
    low, high = (torch.tensor(limit, dtype=p.dtype) for limit in (action.low, action.high))
    return q, low + (high - low) * u


def _unit_hypercube(count: int, dimensions: int, rng: np.random.Generator, nvec: tuple[int, ...]) -> Array:
    """Draw points (count, dimensions) in [0, 1), stratified in each column. The last columns are discrete actions with
    ``nvec`` values each, in the middle of the share of their value."""
    cells = np.stack([rng.permutation(count) for _ in range(dimensions)], 1)
    points = (cells + rng.random((count, dimensions))) / count
    for column, n in enumerate(nvec, start=dimensions - len(nvec)):
        value = (cells[:, column] * n // count + rng.integers(n)) % n
        points[:, column] = (value + 0.5) / n
    return points


def _closest_pair(points: Array) -> float:
    return float(scipy.spatial.distance.pdist(points).min())
