"""Random numbers of lanes (parallel environments). Each is a pure function of seed, lane, episode, step, purpose, and
its position among the numbers that are drawn for these."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
import torch
from torch import Tensor

from surrogym_server.tensors import CPU, sent
from surrogym_server.virtual.lanes import Ints, LaneState
from surrogym_server.virtual.philox import MASK, normals, philox, uniforms
from surrogym_shared import compiled

# The third 32-bit word of the generator's counter has the number of the episode's step in its lowest bits, this many of
# them, and the purpose of the random number in the other eight.
STEP_BITS = 24


class Purpose(IntEnum):
    """Purpose for which a random number is drawn. It is part of the number's key, so that no random number serves two
    purposes."""

    START = 0
    BOX_START = 1
    SPREAD = 2
    TRANSITION = 3
    PATH = 4
    PROCESS = 5
    SENSOR = 6


def uniform_noise(lanes: LaneState, purpose: Purpose, size: int) -> Tensor:
    """Return ``size`` uniform random numbers between 0 and 1 for each of N lanes, (N, size). They depend on the lane's
    seed, number, episode and step, and on the purpose."""
    return uniforms(_words(lanes, purpose, 1, size)).flatten(-2)[:, 0, :size]


def normal_noise(lanes: LaneState, purpose: Purpose, particles: int, size: int) -> Tensor:
    """Return ``size`` standard normal random numbers for each particle of each of N lanes, (N, particles, size). They
    depend on the lane's seed, number, episode and step, and on the purpose."""
    return normals(_words(lanes, purpose, particles, size)).flatten(-2)[..., :size]


def _words(lanes: LaneState, purpose: Purpose, particles: int, size: int) -> Tensor:
    """Return random 32-bit words for N lanes, (N, particles, ceil(size / 4), 4): at least ``size`` words for each
    particle. The last axis is 4 because each value of the generator's counter gives four words."""
    blocks = -(-size // 4)
    third = lanes.elapsed | (int(purpose) << STEP_BITS)
    device = lanes.q.device
    if device == CPU and compiled.available():
        return _compiled_words(lanes, third, particles, blocks)
    draw = torch.arange(particles * blocks, device=device).reshape(1, particles, blocks)
    keys = np.stack([lanes.lane & MASK, lanes.episode & MASK, third, lanes.seed & MASK, (lanes.seed >> 32) & MASK])
    lane, episode, step, low, high = sent(keys, device)[..., None, None].unbind()
    return philox((lane, episode, step, draw), (low, high))


def _compiled_words(lanes: LaneState, third: Ints, particles: int, blocks: int) -> Tensor:
    from surrogym_server.virtual.words import fill

    words = np.empty((len(lanes), particles * blocks, 4), dtype=np.int64)
    fill(lanes.seed, lanes.lane, lanes.episode, third, words)
    return torch.from_numpy(words).reshape(len(lanes), particles, blocks, 4)
