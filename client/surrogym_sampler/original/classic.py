"""Gymnasium's classic control tasks and the swing-up tasks of this package: their specifications, and access to their
state.

The source of every number is the task's Gymnasium class. Angles are in radians. Gymnasium's mountain cars have no unit
of time, so no sampling period.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from surrogym_client.registration import SWING_UP, SWING_UP_NARROW
from surrogym_sampler.original.protocol import Array, Native
from surrogym_sampler.original.swingup import swing_up, swing_up_narrow
from surrogym_shared.kinds import Relation
from surrogym_shared.spec import (
    Bounds,
    BoxAction,
    Coordinate,
    DiscreteAction,
    EnvironmentSpec,
    Fixed,
    Inequality,
    Normal,
    ObservationEntry,
    Reward,
    Success,
    Term,
    Uniform,
)

CIRCLE = Uniform(low=-math.pi, high=math.pi)


@dataclass(frozen=True)
class Task:
    """A known environment, with access to its state.

    Attributes:
        spec: makes its specification.
        write: puts coordinates (C,) into the unwrapped environment, and clears its memory of earlier steps.
        read: returns the coordinates (C,) of the unwrapped environment.
        perturbable: names of the physical attributes that ``--perturb`` may change.
        settle: recomputes further attributes that depend on the changed ones; None if there are none.
    """

    spec: Callable[[], EnvironmentSpec]
    write: Callable[[Native, Array], None]
    read: Callable[[Native], Array]
    perturbable: tuple[str, ...]
    settle: Callable[[Native], None] | None = None


def pendulum() -> EnvironmentSpec:
    """Return the specification of Pendulum-v1: swing the pendulum up and keep it there. The reward depends on the state
    before the step."""
    return EnvironmentSpec(
        environment="Pendulum-v1",
        coordinates=(
            Coordinate(name="theta", kind="angle", sampling=CIRCLE, unit="rad"),
            Coordinate(name="speed", sampling=Uniform(low=-8, high=8), bounds=Bounds(low=-8, high=8), unit="rad/s"),
        ),
        observation=(
            ObservationEntry(name="cos", term=Term.cos(theta=1), low=-1, high=1),
            ObservationEntry(name="sin", term=Term.sin(theta=1), low=-1, high=1),
            ObservationEntry(name="speed", term=Term.linear(speed=1), low=-8, high=8),
        ),
        action=BoxAction(low=(-2.0,), high=(2.0,)),
        start={"theta": CIRCLE, "speed": Uniform(low=-1, high=1)},
        time_limit=200,
        sampling_period=0.05,
        reward=Reward(timing="before"),
        success=Success(hold=(Inequality(term=Term.cos(theta=1), relation=">", value=0.95),), hold_steps=20),
    )


def cartpole() -> EnvironmentSpec:
    """Return the specification of CartPole-v1: keep the pole up. The reward is 1 for each step, including the failing
    one."""
    return _cartpole(
        x=2.4,
        pole=math.radians(12),
        termination=(
            (_inequality("x", ">", 2.4),),
            (_inequality("x", "<", -2.4),),
            (_inequality("pole", ">", math.radians(12)),),
            (_inequality("pole", "<", -math.radians(12)),),
        ),
        time_limit=500,
        min_steps=500,
    )


def cartpole_of_the_paper() -> EnvironmentSpec:
    """Return the specification of CartPole as in the paper's section 5.2: ranges of position and angle that are twice
    as wide as those of CartPole-v1, a learned reward of 0 or 1, and no termination."""
    return _cartpole(x=4.8, pole=math.radians(24), termination=(), time_limit=200, min_steps=195)


def _cartpole(
    x: float, pole: float, termination: tuple[tuple[Inequality, ...], ...], time_limit: int, min_steps: int
) -> EnvironmentSpec:
    sampling = {
        "x": Uniform(low=-x, high=x),
        "velocity": Normal(mean=0, std=1),
        "pole": Uniform(low=-pole, high=pole),
        "omega": Normal(mean=0, std=1),
    }
    shown = {"x": 4.8, "velocity": None, "pole": math.radians(24), "omega": None}
    units = {"x": "m", "velocity": "m/s", "pole": "rad", "omega": "rad/s"}
    return EnvironmentSpec(
        environment="CartPole-v1",
        coordinates=tuple(Coordinate(name=n, sampling=sampling[n], unit=units[n]) for n in sampling),
        observation=tuple(
            ObservationEntry(name=n, term=_linear(n), low=None if top is None else -top, high=top)
            for n, top in shown.items()
        ),
        action=DiscreteAction(n=2),
        start={n: Uniform(low=-0.05, high=0.05) for n in sampling},
        termination=termination,
        time_limit=time_limit,
        sampling_period=0.02,
        reward=Reward(timing="after"),
        success=Success(min_steps=min_steps),
    )


def mountain_car_continuous() -> EnvironmentSpec:
    """Return the specification of MountainCarContinuous-v0: reach the right hill. The reward is 100 on arrival, minus a
    tenth of the squared force in each step.

    Positions are sampled up to 0.52, from where no step reaches the right wall at 0.6, so that only the left wall,
    which also stops the car, has to be declared.
    """
    return _mountain_car("MountainCarContinuous-v0", BoxAction(low=(-1.0,), high=(1.0,)), goal=0.45, time_limit=999)


def mountain_car() -> EnvironmentSpec:
    """Return the specification of MountainCar-v0: reach the right hill with one of three actions; the reward is -1 for
    each step."""
    return _mountain_car("MountainCar-v0", DiscreteAction(n=3), goal=0.5, time_limit=200)


def _mountain_car(
    environment: str, action: BoxAction | DiscreteAction, goal: float, time_limit: int
) -> EnvironmentSpec:
    return EnvironmentSpec(
        environment=environment,
        coordinates=(
            Coordinate(
                name="position",
                sampling=Uniform(low=-1.2, high=0.52),
                bounds=Bounds(low=-1.2, stops="velocity"),
            ),
            Coordinate(name="velocity", sampling=Uniform(low=-0.07, high=0.07), bounds=Bounds(low=-0.07, high=0.07)),
        ),
        observation=(
            ObservationEntry(name="position", term=Term.linear(position=1), low=-1.2, high=0.6),
            ObservationEntry(name="velocity", term=Term.linear(velocity=1), low=-0.07, high=0.07),
        ),
        action=action,
        start={"position": Uniform(low=-0.6, high=-0.4), "velocity": Fixed(value=0)},
        termination=((_inequality("position", ">=", goal), _inequality("velocity", ">=", 0)),),
        time_limit=time_limit,
        reward=Reward(timing="after"),
        success=Success(terminated=True),
    )


def acrobot() -> EnvironmentSpec:
    """Return the specification of Acrobot-v1: swing the tip one link's length above the bar. The reward is -1 for each
    step, and 0 for the last."""
    height = -1 * Term.cos(theta1=1) + -1 * Term.cos(theta1=1, theta2=1)
    speeds = {"speed1": (2.5, 4 * math.pi), "speed2": (5.0, 9 * math.pi)}
    return EnvironmentSpec(
        environment="Acrobot-v1",
        coordinates=(
            Coordinate(name="theta1", kind="angle", sampling=CIRCLE, unit="rad"),
            Coordinate(name="theta2", kind="angle", sampling=CIRCLE, unit="rad"),
            *(
                Coordinate(
                    name=name,
                    sampling=Normal(mean=0, std=std),
                    bounds=Bounds(low=-top, high=top),
                    unit="rad/s",
                )
                for name, (std, top) in speeds.items()
            ),
        ),
        observation=(
            ObservationEntry(name="cos1", term=Term.cos(theta1=1), low=-1, high=1),
            ObservationEntry(name="sin1", term=Term.sin(theta1=1), low=-1, high=1),
            ObservationEntry(name="cos2", term=Term.cos(theta2=1), low=-1, high=1),
            ObservationEntry(name="sin2", term=Term.sin(theta2=1), low=-1, high=1),
            *(ObservationEntry(name=name, term=_linear(name), low=-top, high=top) for name, (_, top) in speeds.items()),
        ),
        action=DiscreteAction(n=3),
        start={name: Uniform(low=-0.1, high=0.1) for name in ("theta1", "theta2", "speed1", "speed2")},
        termination=((Inequality(term=height, relation=">", value=1),),),
        time_limit=500,
        sampling_period=0.2,
        reward=Reward(timing="after"),
        success=Success(terminated=True),
    )


def _linear(name: str) -> Term:
    return Term.linear(**{name: 1.0})


def _inequality(name: str, relation: Relation, value: float) -> Inequality:
    return Inequality(term=_linear(name), relation=relation, value=value)


def _write_state(env: Native, coordinates: Array) -> None:
    env.state = np.array(coordinates, dtype=np.float64)


def _write_pendulum(env: Native, coordinates: Array) -> None:
    _write_state(env, coordinates)
    env.last_u = None


def _write_cartpole(env: Native, coordinates: Array) -> None:
    _write_state(env, coordinates)
    env.steps_beyond_terminated = None


def _write_cartpole_of_the_paper(env: Native, coordinates: Array) -> None:
    _write_state(env, coordinates)
    # 1: the pole counts as fallen already, so that Gymnasium gives the reward 0 outside the limits (the paper's eq. 17)
    env.steps_beyond_terminated = 1


def _settle_cartpole(env: Native) -> None:
    env.total_mass = env.masspole + env.masscart
    env.polemass_length = env.masspole * env.length


def _read_state(env: Native) -> Array:
    return np.array(env.state, dtype=np.float64)


_PENDULUM_PHYSICS = ("g", "m", "l", "max_torque", "max_speed")
_CARTPOLE_PHYSICS = ("masscart", "masspole", "length", "force_mag")
_SWING_UP_PHYSICS = ("masscart", "masspole", "length", "friction")
_ACROBOT_PHYSICS = ("LINK_LENGTH_1", "LINK_MASS_1", "LINK_MASS_2", "LINK_MOI")

TASKS: dict[str, Task] = {
    "Pendulum-v1": Task(pendulum, _write_pendulum, _read_state, _PENDULUM_PHYSICS),
    "CartPole-v1": Task(cartpole, _write_cartpole, _read_state, _CARTPOLE_PHYSICS, _settle_cartpole),
    "MountainCarContinuous-v0": Task(mountain_car_continuous, _write_state, _read_state, ("power", "max_speed")),
    "MountainCar-v0": Task(mountain_car, _write_state, _read_state, ("force", "gravity", "max_speed")),
    "Acrobot-v1": Task(acrobot, _write_state, _read_state, _ACROBOT_PHYSICS),
    SWING_UP: Task(swing_up, _write_state, _read_state, _SWING_UP_PHYSICS),
    SWING_UP_NARROW: Task(swing_up_narrow, _write_state, _read_state, _SWING_UP_PHYSICS),
}

# The tasks that the paper on Active Uncertainty Reduction defines differently from Gymnasium.
PAPER_TASKS: dict[str, Task] = {
    "CartPole-v1": Task(
        cartpole_of_the_paper, _write_cartpole_of_the_paper, _read_state, _CARTPOLE_PHYSICS, _settle_cartpole
    ),
}
