"""Limits of a specification: what contradicts the rest of it is refused, and where the fallback acts."""

from __future__ import annotations

import json
import re
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.stats import binomtest

from support.limited import BRAKE, LIMITS, RAIL, SPEC, with_limits
from surrogym_sampler.original.classic import pendulum
from surrogym_shared.limits import fallback_action, falls_back, left_too_often, limit_of, nearest, past, room
from surrogym_shared.spec import Coordinate, DiscreteAction, EnvironmentSpec, Limit, Limits, Term, Uniform

X = Term.linear(x=1.0)
STILL = (Term.constant(0.0),)
HALF = Term.constant(1.0).model_copy(update={"high": 0.5})  # 1, clipped to 0.5


def limit(**changed: Any) -> Limit:
    return Limit.model_validate({"name": "rail", "term": X, "low": -1.0, "high": 1.0, **changed})


def spec_with(**changed: Any) -> EnvironmentSpec:
    return EnvironmentSpec.model_validate({**SPEC.model_dump(), **changed})


def test_a_declared_limit_without_bound_or_with_overlapping_margins_is_refused() -> None:
    with pytest.raises(ValidationError, match="expected low, high or both"):
        limit(low=None, high=None)
    with pytest.raises(ValidationError, match="expected room between"):
        limit(margin=1.0)


@pytest.mark.parametrize(
    ("keep", "fallback", "said"),
    [
        ((limit(term=Term.linear(y=1.0)),), STILL, "names unknown ['y']"),
        ((limit(), limit()), STILL, "given twice"),
        ((limit(unit="cm"),), STILL, "expected the coordinate's unit 'm'"),
        ((limit(unit="cm", term=Term.linear(x=1.0, v=0.3)),), STILL, "expected the coordinate's unit 'm', got 'cm'"),
        ((limit(unit="cm", term=Term.linear(x=-1.0, v=1.0)),), STILL, "expected the coordinate's unit 'm' or 'm/s'"),
        ((limit(term=Term.linear(x=0.0)),), STILL, "expected a term of the state, got one that is constant"),
        ((limit(term=Term.constant(0.0)),), STILL, "expected a term of the state, got one that is constant"),
        ((limit(low=0.05),), STILL, "every start"),
        ((limit(margin=0.95),), STILL, "every start"),
        ((limit(high=None), limit(name="left", low=None, high=-1.0)), STILL, "contradict each other"),
        ((limit(),), (*STILL, *STILL), "a fallback of 1 terms"),
        ((limit(),), (Term.constant(2.0),), "expected -1 to 1, got 2"),
        ((limit(),), (Term.linear(w=1.0),), "names unknown ['w']"),
    ],
)
def test_declared_limits_that_do_not_fit_the_environment_are_refused(keep: Any, fallback: Any, said: str) -> None:
    with pytest.raises(ValidationError) as refused:
        with_limits(Limits(keep=keep, fallback=fallback))
    assert said in str(refused.value)


@pytest.mark.parametrize(
    ("term", "unit"), [({"x": 100.0, "v": 30.0}, "cm"), ({"x": 1.0, "v": 0.3}, "m"), ({"v": 0.3, "x": -1.0}, "")]
)
def test_a_limit_of_a_weighted_sum_may_have_a_converted_unit_or_none(term: dict[str, float], unit: str) -> None:
    kept = limit(unit=unit, term=Term.linear(**term), low=-100.0, high=100.0)
    assert with_limits(Limits(keep=(kept,), fallback=STILL)).limits


def test_declared_limits_without_sampling_period_or_time_limit_are_refused() -> None:
    with pytest.raises(ValidationError, match="sampling_period"):
        spec_with(sampling_period=None)
    with pytest.raises(ValidationError, match="time_limit"):
        spec_with(time_limit=None)


def test_a_declared_limit_on_an_angle_is_refused_and_on_its_sine_accepted() -> None:
    coordinates = SPEC.model_dump()["coordinates"]
    coordinates[0]["kind"] = "angle"
    coordinates[0]["sampling"] = {"kind": "uniform", "low": -3.0, "high": 3.0}
    with pytest.raises(ValidationError, match="jumps from pi to -pi"):
        spec_with(coordinates=coordinates, limits=Limits(keep=(limit(),), fallback=STILL).model_dump())
    sine = limit(term=Term.sin(x=1.0), low=-0.5, high=0.5)
    assert spec_with(coordinates=coordinates, limits=Limits(keep=(sine,), fallback=STILL).model_dump()).limits


@pytest.mark.parametrize("place", ["limit", "coordinate"])
def test_a_unit_with_control_characters_is_refused(place: str) -> None:
    """A unit is printed on the terminal of whoever reads the status."""
    with pytest.raises(ValidationError, match="string_pattern_mismatch"):
        limit(unit="\x1b[31mrad") if place == "limit" else Coordinate(
            name="x", sampling=Uniform(low=-1, high=1), unit="\x1b[31mrad"
        )


def test_a_discrete_safety_fallback_must_be_a_valid_action_number() -> None:
    discrete = DiscreteAction(n=3).model_dump()
    for fallback, accepted in ((Term.constant(1.0), True), (Term.constant(0.5), False), (HALF, False), (BRAKE, False)):
        limits = Limits(keep=(limit(),), fallback=(fallback,)).model_dump()
        if accepted:
            assert fallback_action(spec_with(action=discrete, limits=limits), np.zeros(2)).tolist() == [1.0]
        else:
            with pytest.raises(ValidationError, match="number of a discrete action"):
                spec_with(action=discrete, limits=limits)


def test_the_remaining_distance_to_a_limit_is_that_to_the_nearer_bound() -> None:
    q = np.array([[0.5, 0.0], [-0.5, -1.0], [1.2, 0.0]])
    np.testing.assert_allclose(room(SPEC, q)[:, 0], [0.5, 0.2, -0.2])
    assert past(SPEC, q).tolist() == [False, False, True]
    assert nearest(SPEC, q[1]) == (RAIL, pytest.approx(0.2))


def test_the_safety_fallback_acts_within_the_margin_of_a_limit_and_one_step_before() -> None:
    far, near = np.array([[0.0, 0.0]]), np.array([[0.65, 0.0]])
    assert falls_back(SPEC, near, near).all()
    assert not falls_back(SPEC, far, far).any()
    moving = np.array([[0.4, 0.0]])
    assert falls_back(SPEC, far, moving).all(), "another step of 0.4 would reach the margin"
    assert not falls_back(SPEC, moving, far).any(), "it moves away"


def test_the_safety_fallback_action_is_clipped_to_the_action_bounds() -> None:
    np.testing.assert_allclose(fallback_action(SPEC, np.array([0.1, 0.1])), [-0.21])
    np.testing.assert_allclose(fallback_action(SPEC, np.array([0.0, 3.0])), [-1.0])


def test_a_one_sided_limit_has_infinite_distance_on_the_other_side() -> None:
    one = with_limits(LIMITS.model_copy(update={"keep": (limit(low=None),)}))
    assert room(one, np.array([[-1e6, 0.0]]))[0, 0] == pytest.approx(1e6 + 1)
    assert not falls_back(one, np.array([[-1.0, 0.0]]), np.array([[-1e6, 0.0]])).any()


@pytest.mark.parametrize(("episodes", "share"), [(1, 0.02), (7, 0.02), (40, 0.3), (2_000, 0.01), (50, 1.0)])
def test_whether_limits_were_left_too_often_is_decided_as_by_the_exact_binomial_test(
    episodes: int, share: float
) -> None:
    for left in range(min(episodes, 60) + 1):
        probability = binomtest(left, episodes, share, alternative="greater").pvalue
        for level in (0.01, 0.05):
            assert left_too_often(left, episodes, share, level) == (probability < level)


def test_a_fallback_may_be_the_name_of_a_program_and_nothing_else() -> None:
    named = {
        **SPEC.model_dump(mode="json"),
        "limits": {**LIMITS.model_dump(mode="json"), "fallback": {"name": "brake"}},
    }
    spec = EnvironmentSpec.model_validate_json(json.dumps(named))
    assert spec.limits is not None
    assert spec.limits.model_dump(mode="json")["fallback"] == {"name": "brake"}
    for wrong in ({"name": "a b; c"}, {"name": "brake", "program": "os:abort"}, {}, []):
        with pytest.raises(ValidationError):
            EnvironmentSpec.model_validate({**named, "limits": {**named["limits"], "fallback": wrong}})


@pytest.mark.parametrize(
    ("text", "weights", "low", "high"),
    [
        ("x<=0.5", {"x": 1}, None, 0.5),
        (" v >= -2.5 ", {"v": 1}, -2.5, None),
        ("x+0.3*v<=1e0", {"x": 1, "v": 0.3}, None, 1),
        ("-2 * v - x >= -3", {"v": -2, "x": -1}, -3, None),
    ],
)
def test_a_limit_in_words_is_read(text: str, weights: dict[str, float], low: float | None, high: float | None) -> None:
    read = limit_of(SPEC, text)
    assert (read.term, read.low, read.high) == (Term.linear(**weights), low, high)
    width = sum(abs(weight) * {"x": 3, "v": 6}[name] for name, weight in weights.items())
    assert read.margin == pytest.approx(0.01 * width)


@pytest.mark.parametrize(
    "text",
    ["", "x", "x<1", "x<=", "x<=fast", "1<=x", "w<=1", "x v<=1", "x*v<=1", "1..2*x<=1", "x" + 1_000 * " " + "<=1"],
)
def test_a_limit_in_other_words_is_refused_with_the_coordinates(text: str) -> None:
    said = (
        "expected a sum of coordinates, <= or >=, and a number, such as x<=1 or 0.3*x+v>=-1, with the coordinates x, v"
    )
    with pytest.raises(ValueError, match=re.escape(f"limit {text!r}: {said}")):
        limit_of(SPEC, text)


def test_a_limit_where_nothing_was_learned_or_that_a_start_violates_is_refused() -> None:
    with pytest.raises(ValueError, match=r"limit 'x<=1.6': expected a number between -1.5 and 1.5, .* got 1.6"):
        limit_of(SPEC, "x<=1.6")
    with pytest.raises(ValueError, match=r"limit 'x<=1e300': high: expected a number less than .*, got 1e\+300"):
        limit_of(SPEC, "x<=1e300")
    with pytest.raises(
        ValueError, match=r"'x>=0': expected every start to be inside by at least 0.03, got .*'x': -0.1"
    ):
        limit_of(SPEC, "x>=0")
    with pytest.raises(
        ValueError, match=r"expected coordinates that are no angles, because an angle jumps from pi to -pi, got theta"
    ):
        limit_of(pendulum(), "theta<=1")
