"""Environments of peers' publications that are none of our tasks. A published figure is reproduced in them first."""

from __future__ import annotations

import math

import numpy as np

from surrogym_client.original.protocol import Array, RealStep
from surrogym_shared.spec import (
    BoxAction,
    Coordinate,
    EnvironmentSpec,
    Fixed,
    Inequality,
    Normal,
    ObservationEntry,
    Success,
    Term,
    Uniform,
)

NAME = f"{__name__}:RodPendulum"
TORQUE, GRAVITY, FRICTION = 2.5, 9.82, 0.01  # N m, m/s^2, N m s; a rod of 1 kg and 1 m
STEP_SECONDS, SUBSTEPS, SECONDS = 0.1, 10, 4.0
WIDTH = 0.5  # m, of the reward


class RodPendulum:
    """The pendulum of Black-DROPS: a rod hangs, and a weak motor has to swing it up within four seconds.

    Equation of motion, reward and limits are those of the authors' program (resibots/blackdrops, pendulum.cpp). An
    angle of 0 hangs. Each step is integrated by Runge and Kutta's method in ten parts.
    """

    parallel = True

    def spec(self) -> EnvironmentSpec:
        return EnvironmentSpec(
            environment=NAME,
            coordinates=(
                Coordinate(name="angle", kind="angle", sampling=Uniform(low=-math.pi, high=math.pi), unit="rad"),
                Coordinate(name="speed", sampling=Normal(mean=0, std=4), unit="rad/s"),
            ),
            observation=(
                ObservationEntry(name="cos", term=Term.cos(angle=1), low=-1, high=1),
                ObservationEntry(name="sin", term=Term.sin(angle=1), low=-1, high=1),
                ObservationEntry(name="speed", term=Term.linear(speed=1)),
            ),
            action=BoxAction(low=(-TORQUE,), high=(TORQUE,)),
            start={"angle": Fixed(value=0), "speed": Fixed(value=0)},
            time_limit=round(SECONDS / STEP_SECONDS),
            success=Success(hold=(Inequality(term=Term.cos(angle=1), relation="<", value=-0.95),), hold_steps=10),
        )

    def step_from(self, coordinates: Array, action: Array) -> RealStep:
        """Apply a torque for a tenth of a second. The reward is that of the state after it."""
        torque = float(np.clip(action[0], -TORQUE, TORQUE))
        state = np.array(coordinates, dtype=np.float64)
        h = STEP_SECONDS / SUBSTEPS
        for _ in range(SUBSTEPS):
            k1 = _slope(state, torque)
            k2 = _slope(state + h / 2 * k1, torque)
            k3 = _slope(state + h / 2 * k2, torque)
            k4 = _slope(state + h * k3, torque)
            state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        state[0] = (state[0] + math.pi) % (2 * math.pi) - math.pi
        return RealStep(coordinates, action, state, reward=float(reward(state[None])[0]))

    def close(self) -> None:
        pass


def reward(reached: Array) -> Array:
    """Rewards (N,) of states (N, 2): exp(-d^2 / (2 width^2)), d the distance of the rod's tip from its goal."""
    paid: Array = np.exp(-(np.sin(reached[:, 0]) ** 2 + (np.cos(reached[:, 0]) + 1) ** 2) / (2 * WIDTH**2))
    return paid


def _slope(state: Array, torque: float) -> Array:
    """Change of angle and speed in a second; the moment of inertia is a third."""
    angle, speed = state
    return np.array([speed, 3 * (torque - FRICTION * speed - GRAVITY * math.sin(angle) / 2)])
