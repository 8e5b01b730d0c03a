"""Philox4x32-10, a counter-based generator, on integer tensors.

Reference: Salmon, Moraes, Dror, Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC 2011. Words have 32 bits and
are kept in int64. A product of two words may overflow int64, but all of its 64 bits are right.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

MASK = 0xFFFFFFFF  # a bitwise "and" with this number keeps the lower 32 bits
MULTIPLIERS = (0xD2511F53, 0xCD9E8D57)  # constants of the generator Philox4x32, M_0 and M_1 in its paper
WEYL = (0x9E3779B9, 0xBB67AE85)  # constants of the generator Philox4x32, added to the key's two words in each round
ROUNDS = 10


def philox(counter: tuple[Tensor, Tensor, Tensor, Tensor], key: tuple[Tensor, Tensor]) -> Tensor:
    """Return four random 32-bit words for each counter (four words) and key (two words), (..., 4) int64 in [0, 2^32).
    The six tensors of words broadcast."""
    c0, c1, c2, c3 = counter
    k0, k1 = key
    for _ in range(ROUNDS):
        high0, low0 = _multiply(MULTIPLIERS[0], c0)
        high1, low1 = _multiply(MULTIPLIERS[1], c2)
        c0, c1, c2, c3 = high1 ^ c1 ^ k0, low1, high0 ^ c3 ^ k1, low0
        k0, k1 = (k0 + WEYL[0]) & MASK, (k1 + WEYL[1]) & MASK
    return torch.stack(torch.broadcast_tensors(c0, c1, c2, c3), -1)  # type: ignore[no-untyped-call]


def uniforms(words: Tensor) -> Tensor:
    """Return uniform numbers in (0, 1), float64, computed from words in [0, 2^32)."""
    return words.to(torch.float64).add_(0.5).mul_(2.0**-32)


def normals(words: Tensor) -> Tensor:
    """Return standard normal numbers (..., 4) from random 32-bit words (..., 4), two from each pair (Box and Muller
    1958)."""
    u = uniforms(words)
    radius = (-2 * u[..., 0::2].log()).sqrt()
    angle = 2 * math.pi * u[..., 1::2]
    return torch.stack([radius * angle.cos(), radius * angle.sin()], -1).flatten(-2)


def _multiply(a: int, b: Tensor) -> tuple[Tensor, Tensor]:
    product = b * a
    return (product >> 32).bitwise_and_(MASK), product.bitwise_and_(MASK)
