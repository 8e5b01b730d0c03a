"""Sensor noise: a measurement error is added to the observed coordinates, and the state itself stays as it is."""

from __future__ import annotations

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.errors import InvalidInput
from surrogym_server.models.abilities import LearnedNoise, offers
from surrogym_server.models.port import DynamicsModel
from surrogym_server.tensors import constant
from surrogym_server.virtual.lanes import LaneState
from surrogym_server.virtual.noise import Purpose, normal_noise

SensorNoise = tuple[tuple[str, float], ...]  # pairs: coordinate's name, standard deviation of its measurement error
# A model learns noise from differences of two measured states, so the learned variance contains the variance of this
# many measurement errors.
MEASURED = 2.0


def sensed(definition: EnvironmentDefinition, noise: SensorNoise, lanes: LaneState) -> Tensor:
    """Return the states of N lanes with measurement errors added, (N, C). New errors are drawn in each step."""
    if not noise:
        return lanes.q
    drawn = normal_noise(lanes, Purpose.SENSOR, 1, len(definition.coordinates))[:, 0]
    return lanes.q + drawn * _spread(definition, noise)


def driving(model: DynamicsModel, noise: SensorNoise, process: Tensor) -> Tensor:
    """Return the standard normal numbers ``process`` (N, ..., M) multiplied by a factor of at most 1 for each of the M
    moving coordinates. The factor removes the part of the learned noise that measurement errors explain."""
    able = offers(model, LearnedNoise)
    if not noise or able is None or model.definition.moves_observation:
        return process
    spread = _spread(model.definition, noise)[model.definition.moving_columns]
    learned = constant(able.noise_stds[:-1], spread.device)
    share = MEASURED * spread.square() / learned.square().clamp_min(torch.finfo(spread.dtype).tiny)
    return process * (1 - share).clamp_min(0).sqrt()


def check(definition: EnvironmentDefinition, noise: SensorNoise) -> None:
    """Raise ``InvalidInput`` unless each coordinate with sensor noise exists and is moved by the dynamics."""
    moving = [definition.coordinate_names[i] for i in definition.moving]
    for name, _ in noise:
        if name not in moving:
            raise InvalidInput(
                f"sensor_noise: expected names of coordinates that change in steps ({', '.join(moving)}), got {name!r}"
            )


def _spread(definition: EnvironmentDefinition, noise: SensorNoise) -> Tensor:
    by_name = dict(noise)
    return constant(tuple(by_name.get(name, 0.0) for name in definition.coordinate_names), definition.device)
