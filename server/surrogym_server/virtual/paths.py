"""Variant ``pathwise``: each episode of a lane follows one function sampled from the posterior (TS-infinity of
PETS)."""

from __future__ import annotations

from dataclasses import replace

from surrogym_server.models.draws import function_draws
from surrogym_server.models.port import DynamicsModel
from surrogym_server.virtual.lanes import LaneState
from surrogym_server.virtual.noise import Purpose, normal_noise


def with_paths(model: DynamicsModel, lanes: LaneState, functions: int | None = None) -> LaneState:
    """Sample the functions of those lanes that are in the first step of their episode.

    A function depends on model, seed, lane and episode alone. With a number of ``functions`` the lane counts modulo
    that number, so that lanes share functions. Its weights are still kept in the state, because computing them with
    other lanes in the same batch could change their last bits.
    """
    fresh = lanes.elapsed == 0
    if not bool(fresh.any()):
        return lanes
    drawing, draws = lanes.take(fresh), function_draws(model, functions)
    keyed = drawing if functions is None else replace(drawing, lane=drawing.lane % functions)
    noise = normal_noise(keyed, Purpose.PATH, 1, draws.path_size)[:, 0]
    started = replace(drawing, path=draws.draw(noise))
    return started if len(started) == len(lanes) else lanes.put(fresh, started)
