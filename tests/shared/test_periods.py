"""Intervals that are off by half of the declared sampling period are named, but for those of simulators."""

from __future__ import annotations

import pytest

from support.rail import SPEC
from surrogym_shared.periods import irregular

TIMED = SPEC.model_copy(update={"sampling_period": 0.1})


def test_intervals_near_the_period_are_not_named():
    assert irregular(TIMED, [0.1, 0.12, 0.08, 0.149, 0.051], 5) == ""
    assert irregular(TIMED, [], 0) == ""


@pytest.mark.parametrize("interval", [0.151, 0.4, 0.049, 0.0])
def test_an_interval_that_is_off_by_half_of_the_period_is_named_with_its_seconds(interval: float):
    assert irregular(TIMED, [0.1] * 13 + [interval], 14) == (
        "1 of 14 intervals between steps are off by half of the sampling period or more, such as "
        f"{interval:.3g} s, where the specification declares 0.1 s"
    )


def test_the_interval_that_is_farthest_off_is_named():
    assert "3 of 8 intervals" in irregular(TIMED, [0.1] * 5 + [0.2, 0.5, 0.04], 8)
    assert "such as 0.5 s" in irregular(TIMED, [0.1] * 5 + [0.2, 0.5, 0.04], 8)


def test_only_the_last_intervals_are_judged():
    assert irregular(TIMED, [0.4] + [0.1] * 6, 3) == ""
    assert "1 of 2 intervals" in irregular(TIMED, [0.4] + [0.1] * 6 + [0.4], 2)
    assert irregular(TIMED, [0.4] + [0.1] * 6, 0) == ""


@pytest.mark.parametrize("interval", [0.001, 0.07, 0.13, 0.2, 30.0])
def test_the_steps_of_a_simulator_that_is_faster_or_slower_than_the_clock_are_not_named(interval: float):
    assert irregular(TIMED, [interval] * 9 + [0.4], 10) == ""


def test_few_intervals_and_a_specification_without_a_period_are_not_judged():
    assert irregular(TIMED, [0.1, 0.1, 0.1, 0.4], 4) == ""
    assert irregular(SPEC, [0.1] * 9 + [0.4], 10) == ""
