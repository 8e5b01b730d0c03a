"""Input probability P_i (eq. 11): kernel density of the states that policies visited, relative to a uniform density.

It has a Gaussian kernel for each coordinate, a von Mises kernel for each angle, and Scott's bandwidth n^(-1/(d+4)) for
n states with d moving coordinates. A uniform density is mixed in, so that no region has the probability 0.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.distributions import scaling
from surrogym_shared.spec import Coordinate, limits

FLOOR = 0.1  # share of the uniform density in the mixture with the density of visited states
BLOCK = 2**17  # number of kernel values computed at once, so that they stay in the cache of a processor core


def log_occupancy(definition: EnvironmentDefinition, states: Tensor, q: Tensor, floor: float = FLOOR) -> Tensor:
    """Return the logarithm (m,) of the input probability P_i at q (m, C): the density of the visited ``states`` (v, C),
    relative to a uniform density over the sampling range.

    The density is a mixture of kernels around the visited states and a uniform density, whose share is ``floor``.
    """
    count, moving = len(states), len(definition.moving)
    bandwidth = count ** (-1 / (moving + 4))
    densities = []
    for block in torch.split(q, max(1, BLOCK // count)):
        log_kernel = torch.zeros(len(block), count, dtype=q.dtype, device=q.device)
        for index in definition.moving:
            log_kernel += _log_kernel(definition.coordinates[index], block[:, index], states[:, index], bandwidth)
        densities.append(torch.logsumexp(log_kernel, 1) - math.log(count))
    density = torch.cat(densities)
    return torch.logaddexp(math.log1p(-floor) + density, density.new_tensor(math.log(floor)))


def _log_kernel(coordinate: Coordinate, at: Tensor, states: Tensor, bandwidth: float) -> Tensor:
    """Return the log density, relative to a uniform density, of one coordinate at m points ``at`` under a kernel around
    each of v ``states``, (m, v)."""
    difference = at[:, None] - states[None]
    if coordinate.kind == "angle":
        spread = _circular_std(states)
        kappa = 1 / (bandwidth * spread).square()
        log_normaliser = torch.log(torch.special.i0e(kappa))  # i0e(k) = i0(k) exp(-k), i0 the modified Bessel function
        return kappa * (difference.cos() - 1) - log_normaliser
    _, scale = scaling(coordinate.sampling)
    width = (bandwidth * states.std(correction=0)).clamp_min(1e-3 * scale)
    low, high = limits(coordinate.sampling)
    log_uniform = -math.log(high - low)
    return -0.5 * (difference / width).square() - width.log() - 0.5 * math.log(2 * math.pi) - log_uniform


def _circular_std(angles: Tensor) -> Tensor:
    length = torch.hypot(angles.cos().mean(), angles.sin().mean()).clamp(1e-9, 1 - 1e-6)
    return (-2 * length.log()).sqrt()
