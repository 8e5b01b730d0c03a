"""Specifications of the MuJoCo environments whose observation and termination can be expressed by terms."""

from __future__ import annotations

import math
from collections.abc import Callable

from surrogym_shared.spec import (
    BoxAction,
    Coordinate,
    EnvironmentSpec,
    Inequality,
    Normal,
    ObservationEntry,
    Reward,
    Success,
    Term,
    Uniform,
)


def inverted_pendulum() -> EnvironmentSpec:
    """Return the specification of InvertedPendulum-v5. Unlike in Gymnasium, episodes also terminate at the ends of
    the rail, because nothing beyond them is worth learning."""
    sampling = {
        "slider": Uniform(low=-0.95, high=0.95),
        "hinge": Uniform(low=-0.2, high=0.2),
        "slider_velocity": Normal(mean=0, std=1),
        "hinge_velocity": Normal(mean=0, std=2),
    }
    return EnvironmentSpec(
        environment="InvertedPendulum-v5",
        coordinates=tuple(Coordinate(name=name, sampling=s) for name, s in sampling.items()),
        observation=tuple(ObservationEntry(name=name, term=_linear(name)) for name in sampling),
        action=BoxAction(low=(-3.0,), high=(3.0,)),
        start={name: Uniform(low=-0.01, high=0.01) for name in sampling},
        termination=(*_outside("hinge", 0.2), *_outside("slider", 0.95)),
        time_limit=1000,
        sampling_period=0.04,
        reward=Reward(timing="after"),
        success=Success(min_steps=1000),
    )


def inverted_double_pendulum() -> EnvironmentSpec:
    """Return the specification of InvertedDoublePendulum-v5. Its constraint force is 0 except at the rail's ends, where
    episodes terminate."""
    sampling = {
        "slider": Uniform(low=-0.9, high=0.9),
        "hinge": Uniform(low=-0.5, high=0.5),
        "hinge2": Uniform(low=-0.5, high=0.5),
        "slider_velocity": Normal(mean=0, std=1),
        "hinge_velocity": Normal(mean=0, std=1.5),
        "hinge2_velocity": Normal(mean=0, std=2),
    }
    height = 0.6 * Term.cos(hinge=1) + 0.6 * Term.cos(hinge=1, hinge2=1)
    positions, speeds = list(sampling)[:3], list(sampling)[3:]
    return EnvironmentSpec(
        environment="InvertedDoublePendulum-v5",
        coordinates=tuple(Coordinate(name=name, sampling=s) for name, s in sampling.items()),
        observation=(
            ObservationEntry(name="slider", term=_linear("slider")),
            *(ObservationEntry(name=f"sin_{name}", term=Term.sin(**{name: 1.0})) for name in positions[1:]),
            *(ObservationEntry(name=f"cos_{name}", term=Term.cos(**{name: 1.0})) for name in positions[1:]),
            *(ObservationEntry(name=name, term=_linear(name).clipped(-10, 10)) for name in speeds),
            ObservationEntry(name="constraint", term=Term.constant(0)),
        ),
        action=BoxAction(low=(-1.0,), high=(1.0,)),
        start={
            **{name: Uniform(low=-0.1, high=0.1) for name in positions},
            **{name: Normal(mean=0, std=0.1) for name in speeds},
        },
        termination=(
            (Inequality(term=height, relation="<=", value=1),),
            *_outside("slider", 0.9),
        ),
        time_limit=1000,
        sampling_period=0.05,
        reward=Reward(timing="after"),
        success=Success(min_return=9000),
    )


def reacher() -> EnvironmentSpec:
    """Return the specification of Reacher-v5. Gymnasium draws targets from a disc of radius 0.2; here they come from
    the square around it."""
    square = Uniform(low=-0.2, high=0.2)
    speed = Normal(mean=0, std=6)
    return EnvironmentSpec(
        environment="Reacher-v5",
        coordinates=(
            Coordinate(name="joint0", kind="angle", sampling=Uniform(low=-math.pi, high=math.pi), unit="rad"),
            Coordinate(name="joint1", sampling=Uniform(low=-2.8, high=2.8), unit="rad"),
            Coordinate(name="joint0_velocity", sampling=speed, unit="rad/s"),
            Coordinate(name="joint1_velocity", sampling=speed, unit="rad/s"),
            Coordinate(name="target_x", kind="constant", sampling=square, unit="m"),
            Coordinate(name="target_y", kind="constant", sampling=square, unit="m"),
        ),
        observation=_reacher_observation(),
        action=BoxAction(low=(-1.0, -1.0), high=(1.0, 1.0)),
        start={
            **{name: Uniform(low=-0.1, high=0.1) for name in ("joint0", "joint1")},
            **{name: Uniform(low=-0.005, high=0.005) for name in ("joint0_velocity", "joint1_velocity")},
            "target_x": square,
            "target_y": square,
        },
        time_limit=50,
        sampling_period=0.02,
        reward=Reward(timing="after"),
        success=Success(min_return=-6),
    )


def _reacher_observation() -> tuple[ObservationEntry, ...]:
    fingertip_x = 0.1 * Term.cos(joint0=1) + 0.11 * Term.cos(joint0=1, joint1=1)
    fingertip_y = 0.1 * Term.sin(joint0=1) + 0.11 * Term.sin(joint0=1, joint1=1)
    terms = {
        "cos_joint0": Term.cos(joint0=1),
        "cos_joint1": Term.cos(joint1=1),
        "sin_joint0": Term.sin(joint0=1),
        "sin_joint1": Term.sin(joint1=1),
        "target_x": _linear("target_x"),
        "target_y": _linear("target_y"),
        "joint0_velocity": _linear("joint0_velocity"),
        "joint1_velocity": _linear("joint1_velocity"),
        "to_target_x": fingertip_x + Term.linear(target_x=-1),
        "to_target_y": fingertip_y + Term.linear(target_y=-1),
    }
    return tuple(ObservationEntry(name=name, term=term) for name, term in terms.items())


def _linear(name: str) -> Term:
    return Term.linear(**{name: 1.0})


def _outside(name: str, limit: float) -> tuple[tuple[Inequality, ...], ...]:
    above = Inequality(term=_linear(name), relation=">", value=limit)
    below = Inequality(term=_linear(name), relation="<", value=-limit)
    return (above,), (below,)


SPECIFICATIONS: dict[str, Callable[[], EnvironmentSpec]] = {
    "InvertedPendulum-v5": inverted_pendulum,
    "InvertedDoublePendulum-v5": inverted_double_pendulum,
    "Reacher-v5": reacher,
}
