"""Variant ``pathwise``: each episode of a lane follows one function drawn from the posterior (TS-infinity of PETS)."""

from __future__ import annotations

from dataclasses import replace

from surrogym_server.models.gaussian_process.prediction.model import GaussianProcessModel
from surrogym_server.virtual.lanes import LaneState
from surrogym_server.virtual.noise import Purpose, normal_noise


def with_paths(model: GaussianProcessModel, lanes: LaneState) -> LaneState:
    """Lanes whose functions are drawn: those in the first step of their episode draw it now, under its model.

    A draw is a pure function of model, seed, lane and episode. It is kept in the state all the same: solving for other
    lanes beside it could change its last bits.
    """
    fresh = lanes.elapsed == 0
    if not bool(fresh.any()):
        return lanes
    drawing = lanes.take(fresh)
    noise = normal_noise(drawing, Purpose.PATH, 1, model.path_size)[:, 0]
    drawn = replace(drawing, path=model.draw(noise))
    return drawn if len(drawn) == len(lanes) else lanes.put(fresh, drawn)
