"""Noise of a lane: a pure function of (seed, lane, episode, step, purpose, particle, output)."""

from __future__ import annotations

from enum import IntEnum

import torch
from torch import Tensor

from surrogym_server.virtual.lanes import LaneState
from surrogym_server.virtual.philox import MASK, normals, philox, uniforms

STEP_BITS = 24  # of the counter's third word; the purpose has the other eight


class Purpose(IntEnum):
    """What a number is drawn for, so that no two uses share one."""

    START = 0
    BOX_START = 1
    SPREAD = 2
    TRANSITION = 3
    PATH = 4
    PROCESS = 5


def uniform_noise(lanes: LaneState, purpose: Purpose, size: int) -> Tensor:
    """Uniform numbers in (0, 1), (N, size)."""
    return uniforms(_words(lanes, purpose, 1, size)).flatten(-2)[:, 0, :size]


def normal_noise(lanes: LaneState, purpose: Purpose, particles: int, size: int) -> Tensor:
    """Standard normal numbers, (N, particles, size)."""
    return normals(_words(lanes, purpose, particles, size)).flatten(-2)[..., :size]


def _words(lanes: LaneState, purpose: Purpose, particles: int, size: int) -> Tensor:
    """Random words, (N, particles, ceil(size / 4), 4): one counter gives four of them."""
    blocks = -(-size // 4)
    draw = torch.arange(particles * blocks, device=lanes.seed.device).reshape(1, particles, blocks)
    seed, lane, episode, step = (x[:, None, None] for x in (lanes.seed, lanes.lane, lanes.episode, lanes.elapsed))
    third = step | (int(purpose) << STEP_BITS)
    return philox((lane & MASK, episode & MASK, third, draw), (seed & MASK, (seed >> 32) & MASK))
