"""Variant ``pathwise``: each episode of a lane follows one function sampled from the posterior (TS-infinity of
PETS)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from surrogym_server.models.draws import function_draws
from surrogym_server.models.port import DynamicsModel
from surrogym_server.virtual.lanes import LaneState
from surrogym_server.virtual.noise import Purpose, normal_noise

BLOCK = 4_096  # lanes whose functions are sampled at once: their random numbers take five times the memory of functions


def with_paths(model: DynamicsModel, lanes: LaneState, functions: int | None = None) -> LaneState:
    """Return the lanes, with a newly sampled function for each lane that is in the first step of its episode.

    A function is determined by the model and by the seed, number and episode of the lane. If ``functions`` is given,
    the number of the lane counts modulo ``functions``, so that lanes share functions. The weights of a function are
    stored in the lane's state: computed again in a batch with other lanes, they could differ in the last bits.
    """
    fresh = lanes.elapsed == 0
    if not fresh.any():
        return lanes
    drawing, draws = lanes.take(fresh), function_draws(model, functions)
    keyed = drawing if functions is None else replace(drawing, lane=drawing.lane % functions)
    blocks = np.array_split(np.arange(len(keyed)), range(BLOCK, len(keyed), BLOCK))
    drawn = [draws.draw(normal_noise(keyed.take(b), Purpose.PATH, 1, draws.path_size)[:, 0]) for b in blocks]
    started = replace(drawing, path=drawn[0] if len(drawn) == 1 else torch.cat(drawn))
    return started if len(started) == len(lanes) else lanes.put(fresh, started)
