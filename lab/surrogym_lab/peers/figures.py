"""Environments of peers' publications that are none of our tasks. A published figure is reproduced in them first."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any

import numpy as np

from surrogym_sampler.original.protocol import Array, RealStep
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

NAME, CART_NAME = f"{__name__}:RodPendulum", f"{__name__}:MujocoCartPole"
TORQUE, GRAVITY, FRICTION = 2.5, 9.82, 0.01  # N m, m/s^2, N m s; a rod of 1 kg and 1 m
STEP_SECONDS, SUBSTEPS, SECONDS = 0.1, 10, 4.0
WIDTH = 0.5  # m, of the reward
POLE = 0.6  # m, of the cart-pole in MuJoCo
CART_CONTROL, CART_STEPS = 3.0, 200  # the largest control, steps of an episode
CART_MODEL = """
<mujoco>
  <compiler inertiafromgeom="true"/>
  <option gravity="0 0 -9.81" integrator="RK4" timestep="0.02"/>
  <default><joint damping="1"/><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body>
      <joint name="slider" type="slide" axis="1 0 0" limited="true" range="-2.5 2.5"/>
      <geom type="capsule" quat="0.707 0 0.707 0" size="0.1 0.1"/>
      <body>
        <joint name="hinge" type="hinge" axis="0 1 0" limited="false"/>
        <geom type="capsule" fromto="0 0 0 0.001 0 -0.6" size="0.049"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="slider" gear="100" ctrllimited="true" ctrlrange="-3 3"/></actuator>
</mujoco>
"""


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


class MujocoCartPole:
    """The cart-pole of PETS: a pole hangs from a cart with a strong motor, and has to be swung up in eight seconds.

    Masses, joints, reward and starts are those of the authors' program (kchua/handful-of-trials, env/cartpole.py). An
    angle of 0 hangs. A step lasts 0.04 seconds. Needs ``mujoco``.
    """

    parallel = True

    def spec(self) -> EnvironmentSpec:
        near = Normal(mean=0, std=0.1)
        return EnvironmentSpec(
            environment=CART_NAME,
            coordinates=(
                Coordinate(name="position", sampling=Uniform(low=-2.5, high=2.5), unit="m"),
                Coordinate(name="angle", kind="angle", sampling=Uniform(low=-math.pi, high=math.pi), unit="rad"),
                Coordinate(name="velocity", sampling=Normal(mean=0, std=3), unit="m/s"),
                Coordinate(name="spin", sampling=Normal(mean=0, std=6), unit="rad/s"),
            ),
            observation=(
                ObservationEntry(name="position", term=Term.linear(position=1)),
                ObservationEntry(name="cos", term=Term.cos(angle=1), low=-1, high=1),
                ObservationEntry(name="sin", term=Term.sin(angle=1), low=-1, high=1),
                ObservationEntry(name="velocity", term=Term.linear(velocity=1)),
                ObservationEntry(name="spin", term=Term.linear(spin=1)),
            ),
            action=BoxAction(low=(-CART_CONTROL,), high=(CART_CONTROL,)),
            start=dict.fromkeys(("position", "angle", "velocity", "spin"), near),
            time_limit=CART_STEPS,
        )

    @cached_property
    def _simulation(self) -> tuple[Any, Any]:
        import mujoco

        model = mujoco.MjModel.from_xml_string(CART_MODEL)
        return model, mujoco.MjData(model)

    def step_from(self, coordinates: Array, action: Array) -> RealStep:
        """Apply a control for two steps of MuJoCo. The reward is that of the state after it, less a price."""
        import mujoco

        model, data = self._simulation
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = coordinates[:2], coordinates[2:]
        data.ctrl[:] = np.clip(action, -CART_CONTROL, CART_CONTROL)
        mujoco.mj_step(model, data, nstep=2)
        state = np.concatenate([data.qpos, data.qvel])
        state[1] = (state[1] + math.pi) % (2 * math.pi) - math.pi
        return RealStep(coordinates, action, state, reward=float(cart_reward(state[None], action[None])[0]))

    def close(self) -> None:
        pass


def cart_reward(reached: Array, action: Array) -> Array:
    """Rewards (N,) of states (N, 4) and the actions (N, 1) before: exp(-d^2 / length^2) - 0.01 a^2, d the distance of
    the pole's tip from its goal."""
    across = reached[:, 0] - POLE * np.sin(reached[:, 1])
    below = POLE * (1 + np.cos(reached[:, 1]))
    paid: Array = np.exp(-(across**2 + below**2) / POLE**2) - 0.01 * action[:, 0] ** 2
    return paid


def _slope(state: Array, torque: float) -> Array:
    """Change of angle and speed in a second; the moment of inertia is a third."""
    angle, speed = state
    return np.array([speed, 3 * (torque - FRICTION * speed - GRAVITY * math.sin(angle) / 2)])
