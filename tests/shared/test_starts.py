"""States after resets beside the declared starts: what is named, and what is noise, a lag or unknown."""

from __future__ import annotations

import math

import numpy as np
import pytest

from support import rail
from surrogym_shared.spec import Coordinate, Fixed, Lag, Normal, Uniform
from surrogym_shared.starts import not_declared


def with_coordinate(coordinate: Coordinate, start: Fixed | Normal | Uniform):
    content = rail.SPEC.model_dump() | {"coordinates": (coordinate,), "start": {"x": start}, "termination": ()}
    return type(rail.SPEC).model_validate(content)


@pytest.mark.parametrize("x", [-0.2, 0.0, 0.2, 0.39, -0.39, math.nan])
def test_a_declared_start_with_noise_or_an_unknown_one_is_not_named(x):
    assert not_declared(rail.SPEC, [[x]]) == ""


def test_resets_elsewhere_are_counted_and_the_farthest_is_named():
    assert not_declared(rail.SPEC, [[0.1], [0.5], [-0.9]]) == (
        "2 of 3 resets led to no declared start, such as x = -0.9, where the specification declares -0.2 to 0.2"
    )


def test_no_reset_is_no_fault():
    assert not_declared(rail.SPEC, []) == ""


def test_an_angle_is_compared_over_the_turn():
    angle = Coordinate(name="x", kind="angle", sampling=Uniform(low=-math.pi, high=math.pi))
    spec = with_coordinate(angle, Fixed(value=math.pi))
    assert not_declared(spec, [[-math.pi + 0.01]]) == ""
    assert "x = 0," in not_declared(spec, [[0.0]])
    assert not_declared(spec, [[0.0]]).endswith("declares 3.142")
    assert not_declared(spec, [[math.inf]]) == "", "what is no finite number is refused elsewhere"


def test_starts_of_a_list_are_the_declared_ones():
    spec = rail.SPEC.model_copy(update={"starts": ((0.7,), (0.9,))})
    assert not_declared(spec, [np.array([0.8])]) == ""
    assert "declares 0.7 to 0.9" in not_declared(spec, [np.array([0.0])])


def test_a_lag_is_not_compared():
    lag = Coordinate(name="x", sampling=Uniform(low=-1, high=1), lag=Lag(kind="action", entry=0))
    spec = rail.SPEC.model_copy(update={"coordinates": (lag,)})
    assert not_declared(spec, [[0.9]]) == ""
