"""Coordinates that wrap without being angles are named with the number by which they jump."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest

from support.wheel import SPEC
from surrogym_shared.spec import Coordinate, EnvironmentSpec, Lag, Uniform
from surrogym_shared.wrapping import FEWEST, undeclared_turns


@dataclass
class Step:
    coordinates: list[float]
    action: list[float]
    next_coordinates: list[float]


def turning(turn: float, count: int = 60, noise: float = 0.0) -> list[Step]:
    """Steps of a wheel that turns by about a tenth of a turn."""
    rng, x, steps = np.random.default_rng(0), 0.0, []
    for _ in range(count):
        u = rng.uniform(0.5, 1)
        x_next = x + turn * (0.1 * u + noise * rng.standard_normal())
        steps.append(Step([x % turn], [u], [x_next % turn]))
        x = x_next
    return steps


def spec_of(turn: float, kind: str = "linear") -> EnvironmentSpec:
    x = Coordinate(name="x", kind=kind, sampling=Uniform(low=-math.pi, high=math.pi))
    return SPEC.model_copy(update={"coordinates": (x,)})


@pytest.mark.parametrize(
    ("turn", "said"),
    [
        (2048.0, "as an angle or a clock in counts does: multiply it by 2 pi / 2048, and declare it as an angle"),
        (2 * math.pi, "as an angle or a clock in radians does: declare it as an angle"),
        (360.0, "as an angle or a clock in degrees does: multiply it by 2 pi / 360, and declare it as an angle"),
    ],
)
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_coordinate_that_wraps_is_named_with_the_number_by_which_it_jumps(turn: float, said: str, noise: float):
    steps = turning(turn, noise=noise)
    jumps = sum(step.next_coordinates < step.coordinates for step in steps)
    assert undeclared_turns(spec_of(turn), steps, 60) == f"x jumps by {turn:.4g} in {jumps} of 60 steps, {said}"


def test_only_the_judged_steps_are_counted():
    steps = turning(2048.0)
    last = next(i for i in range(60, 0, -1) if steps[i - 1].next_coordinates < steps[i - 1].coordinates)
    spec = spec_of(2048.0)
    assert undeclared_turns(spec, steps[:last], 1).startswith("x jumps by 2048 in 1 of 1 steps")
    assert undeclared_turns(spec, steps[: last - 1], 1) == ""
    assert undeclared_turns(spec, steps, 0) == ""


def test_a_declared_angle_and_a_coordinate_that_does_not_jump_are_not_named():
    assert undeclared_turns(spec_of(2 * math.pi, "angle"), turning(2 * math.pi), 60) == ""
    assert undeclared_turns(spec_of(2048.0), turning(2048.0)[:5] * 5, 25) == ""


def test_a_jump_that_does_not_continue_the_motion_is_no_turn():
    """A tank whose siphon empties it at once."""
    rng, x, steps = np.random.default_rng(0), 0.0, []
    for _ in range(100):
        x_next = x + rng.uniform(20, 60) if x < 700 else 0.0
        steps.append(Step([x], [1.0], [x_next]))
        x = x_next
    assert undeclared_turns(spec_of(700.0), steps, len(steps)) == ""


def test_few_steps_show_no_turn():
    steps = turning(2048.0, FEWEST)
    assert undeclared_turns(spec_of(2048.0), steps, FEWEST) != ""
    assert undeclared_turns(spec_of(2048.0), steps[:-1], FEWEST - 1) == ""


def test_lags_are_not_compared():
    lag = Coordinate(name="x1", sampling=Uniform(low=0, high=2048), lag=Lag(kind="value", of="x"))
    spec = SPEC.model_copy(update={"coordinates": (*SPEC.coordinates, lag)})
    steps = [Step([*s.coordinates, 0.0], s.action, [*s.next_coordinates, *s.coordinates]) for s in turning(2048.0)]
    assert undeclared_turns(spec, steps, 60).count("jumps by") == 1
