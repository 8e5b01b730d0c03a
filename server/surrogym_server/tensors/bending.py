"""Inputs along which a function changes the faster the further, and its amplitude there; ``gp.growth`` has the law."""

from __future__ import annotations

import torch
from torch import Tensor

STEEPEST = 2.0  # largest rate
EDGE = 2.0  # |z| beyond which no exponential is followed


def bend(z: Tensor, rates: Tensor) -> Tensor:
    """w(z) = (e^(g z) - 1) / g of inputs z (..., d) and rates g (d,); z where the rate is 0.

    Beyond ``EDGE`` an exponential would overflow. There w is a line on the steep side, and constant on the flat side.
    """
    size, sign = rates.abs(), rates.sign()
    along = (z * sign).clamp_min(-EDGE)  # grows towards the steep side
    beyond = (along - EDGE).clamp_min(0)
    bent = torch.expm1(size * along.clamp_max(EDGE)) / torch.where(size == 0, 1.0, size)
    return torch.where(rates == 0, z, sign * (bent + torch.exp(size * EDGE) * beyond))


def amplitude(w: Tensor, rates: Tensor) -> Tensor:
    """a(z) = prod_j e^(g_j z_j) = prod_j (1 + g_j w_j) of bent inputs w(z) (..., d) and rates g (d,), (...)."""
    grown: Tensor = (1 + w * rates).prod(-1)
    return grown
