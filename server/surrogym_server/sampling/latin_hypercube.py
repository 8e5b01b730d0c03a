"""Latin hypercube over states and actions (section 3.2 of the paper): each input is divided into equally probable
intervals with one point in each."""

from __future__ import annotations

import numpy as np
import scipy  # SciPy imports its submodules on first use, so a server that needs none of them starts sooner
import torch
from numpy.typing import NDArray
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.distributions import quantiles

Array = NDArray[np.float64]
# Greatest number of times that points in terminal states, or within the margin of a declared limit, are drawn again.
REDRAWS = 100


def latin_hypercube(
    definition: EnvironmentDefinition, count: int, rng: np.random.Generator, tries: int = 1
) -> tuple[Tensor, Tensor]:
    """Draw a Latin hypercube of ``count`` points: coordinates (count, C) and actions (count, F).

    Each coordinate has one point in each of ``count`` intervals of equal probability, so the points follow the sampling
    distributions. Discrete actions are balanced: the numbers of points with two different actions differ by at most
    one. Of ``tries`` random hypercubes, the one whose closest two points are farthest apart is returned.
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
    """Replace some of the points q (n, C), u (n, F) by other random points: those at which the declared termination
    holds, and those within the margin of a limit.

    A query in a terminated state would teach nothing, because no episode continues there. The sampler refuses queries
    within the margin of a limit. If no other points are found, the points stay.
    """
    q, u = q.clone(), u.clone()
    for _ in range(REDRAWS):
        over = definition.terminated(q) | definition.falls_back(q, q)
        if not bool(over.any()):
            break
        q[over], u[over] = random_points(definition, int(over.sum()), rng)
    return q, u


def from_unit(definition: EnvironmentDefinition, p: Tensor) -> tuple[Tensor, Tensor]:
    """Map probabilities p (n, C + F) in [0, 1) to coordinates (n, C) and actions (n, F) by the quantile functions of
    the sampling distributions."""
    size = len(definition.coordinates)
    q = quantiles([c.sampling for c in definition.coordinates], p[:, :size])
    action, u = definition.action, p[:, size:]
    if action.nvec:
        return q, torch.floor(u * torch.tensor(action.nvec, dtype=p.dtype))
    low, high = torch.tensor(action.ranges, dtype=p.dtype).T
    return q, low + (high - low) * u


def _unit_hypercube(count: int, dimensions: int, rng: np.random.Generator, nvec: tuple[int, ...]) -> Array:
    """Draw a Latin hypercube of points (count, dimensions) in [0, 1). The last columns are discrete actions: an action
    with k values in ``nvec`` is represented by the middle of one of k equal parts of [0, 1)."""
    cells = np.stack([rng.permutation(count) for _ in range(dimensions)], 1)
    points = (cells + rng.random((count, dimensions))) / count
    for column, n in enumerate(nvec, start=dimensions - len(nvec)):
        value = (cells[:, column] * n // count + rng.integers(n)) % n
        points[:, column] = (value + 0.5) / n
    return points


def _closest_pair(points: Array) -> float:
    return float(scipy.spatial.distance.pdist(points).min())
