"""Other set points of a declared reward: one number of the specification changes, and misfits are refused."""

from __future__ import annotations

from typing import Any

import pytest

from surrogym_shared.set_points import set_points_of, with_set_points
from surrogym_shared.spec import (
    BoxAction,
    Coordinate,
    DeclaredReward,
    EnvironmentSpec,
    Inequality,
    ObservationEntry,
    Quantity,
    RewardTerm,
    Success,
    Term,
    Uniform,
)

LEVEL, FLOW = Term.linear(level=1), Term.linear(flow=1)


def error(set_point: float, scale: float = 0.5) -> Quantity:
    return Quantity(term=Term.linear(level=scale) + Term.constant(-scale * set_point))


def spec(*terms: RewardTerm, **changed: Any) -> EnvironmentSpec:
    """A tank whose level and inflow are measured."""
    fields: dict[str, Any] = {
        "environment": "tank",
        "coordinates": tuple(Coordinate(name=n, sampling=Uniform(low=0, high=20)) for n in ("level", "flow")),
        "observation": tuple(ObservationEntry(name=n, term=t) for n, t in (("level", LEVEL), ("flow", FLOW))),
        "action": BoxAction(low=(-1,), high=(1,)),
        "start": {n: Uniform(low=0, high=20) for n in ("level", "flow")},
        "time_limit": 50,
        "reward": DeclaredReward(kind="declared", terms=terms),
    }
    return EnvironmentSpec(**{**fields, **changed})


def tank(set_point: float, **changed: Any) -> EnvironmentSpec:
    """A tank whose reward measures the error of its level twice, and its inflow, action and overflow besides."""
    over = Quantity(term=(LEVEL + Term.constant(-18.0)).clipped(0, None))
    return spec(
        RewardTerm(shape="bump", of=(error(set_point),)),
        RewardTerm(shape="square", weight=-0.1, of=(error(set_point, -2.0),)),
        RewardTerm(shape="linear", weight=-0.1, of=(Quantity(term=FLOW),)),
        RewardTerm(shape="square", weight=-0.1, of=(Quantity(action=(1.0,)),)),
        RewardTerm(shape="square", weight=-9.0, of=(over,)),
        **changed,
    )


def test_a_set_point_is_the_value_without_error():
    assert set_points_of(tank(10)) == {"level": (10,)}
    assert set_points_of(tank(10).model_copy(update={"reward": {"kind": "learned"}})) == {}


def test_another_set_point_gives_the_reward_that_is_declared_for_it():
    assert with_set_points(tank(10), {"level": 12.5}).reward == tank(12.5).reward
    assert with_set_points(tank(10), {}) == tank(10)


def test_set_points_that_differ_by_a_rounding_error_are_one():
    assert -(-0.1 * 0.7) / 0.1 != -(-0.3 * 0.7) / 0.3 != -(-3.9 * 0.7) / 3.9
    three = spec(*(RewardTerm(shape="bump", of=(error(0.7, scale),)) for scale in (0.1, 0.3, 3.9)))
    assert set_points_of(three) == {"level": (pytest.approx(0.7),)}
    assert set_points_of(with_set_points(three, {"level": 1.7})) == {"level": (pytest.approx(1.7),)}


def test_criteria_of_success_belong_to_the_declared_set_point():
    criterion = Success(hold=(Inequality(term=LEVEL, relation=">", value=9.0),))
    assert with_set_points(tank(10, success=criterion), {"level": 12.5}).success is None


@pytest.mark.parametrize("value", [-1, 21, float("nan"), True, "12"])
def test_a_set_point_outside_of_the_sampling_range_is_refused(value):
    with pytest.raises(ValueError, match=f"expected a number in the sampling range, 0 to 20, .*, got {value!r}"):
        with_set_points(tank(10), {"level": value})


@pytest.mark.parametrize("name", ["flow", "pressure"])
def test_a_coordinate_without_a_set_point_is_refused_and_the_known_ones_are_named(name):
    with pytest.raises(ValueError, match=rf"measures by itself \('level'\), got '{name}'"):
        with_set_points(tank(10), {name: 12})


def test_a_reward_that_measures_a_coordinate_from_two_values_has_no_single_set_point():
    two = spec(RewardTerm(shape="bump", of=(error(10),)), RewardTerm(shape="bump", of=(error(12),)))
    with pytest.raises(ValueError, match="one set point of 'level', got one with several: 10, 12"):
        with_set_points(two, {"level": 14})


def test_a_learned_reward_has_no_set_points():
    learned = EnvironmentSpec.model_validate({**tank(10).model_dump(), "reward": {"kind": "learned"}})
    with pytest.raises(ValueError, match="expected a specification that declares the reward, got one whose reward is"):
        with_set_points(learned, {"level": 12})


def test_a_set_point_beyond_a_condition_of_the_reward_or_a_termination_is_refused():
    high = Inequality(term=LEVEL, relation=">", value=15.0)
    alarm = spec(RewardTerm(shape="bump", of=(error(10),)), RewardTerm(shape="one", weight=-5, when=(high,)))
    ends = tank(10, termination=((high,),))
    for one, said in ((alarm, "a condition of the reward"), (ends, "a termination")):
        assert with_set_points(one, {"level": 14}).reward != one.reward
        with pytest.raises(ValueError, match=f"expected a value at which {said} of 'level' holds as .* 10, .* got 16"):
            with_set_points(one, {"level": 16})
