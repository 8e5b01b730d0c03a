"""Rates of an action: what they allow, and which specifications can't have them."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from support.controllers import plant
from surrogym_shared.rates import rates, within_rates
from surrogym_shared.spec import DiscreteAction, EnvironmentSpec

RATED = plant(actions=1, rate=(20.0, None))  # 20 a second are 1 a step of 0.05 s


def state(last: float) -> np.ndarray:
    coordinates = np.zeros(len(RATED.coordinates))
    coordinates[RATED.coordinate_names.index("action0.lag1")] = last
    return coordinates


@pytest.mark.parametrize(
    ("last", "asked", "kept"), [(0.0, 2.0, 1.0), (0.0, -0.4, -0.4), (1.5, -2.0, 0.5), (-2.0, 2.0, -1.0)]
)
def test_an_action_entry_with_a_rate_changes_by_at_most_rate_times_period_and_others_freely(last, asked, kept):
    np.testing.assert_allclose(within_rates(rates(RATED), state(last), np.array([asked, 9.0])), [kept, 9.0])


def test_a_specification_without_rates_of_action_change_leaves_actions_unchanged():
    assert rates(plant(actions=1)) == ()
    np.testing.assert_array_equal(within_rates(rates(plant()), np.zeros(3), np.array([2.0, 9.0])), [2.0, 9.0])


def changed(**fields) -> dict:
    return {**RATED.model_dump(), **fields}


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"sampling_period": None}, "expected a sampling_period"),
        ({"action": {**RATED.action.model_dump(), "rate": (20.0,)}}, "expected 2 entries in rate"),
        ({"action": {**RATED.action.model_dump(), "rate": (0.0, None)}}, "greater than 0"),
        ({**plant().model_dump(), "action": RATED.action.model_dump()}, "with_history"),
    ],
    ids=["no period", "another length", "a rate of 0", "no last action"],
)
def test_a_specification_whose_rate_of_action_change_cannot_be_kept_is_refused_with_the_reason(fields, said):
    with pytest.raises(ValidationError, match=said):
        EnvironmentSpec.model_validate(changed(**fields))


def test_declaring_a_largest_rate_of_change_for_a_discrete_action_is_refused():
    with pytest.raises(ValueError, match="continuous action"):
        plant(DiscreteAction(n=3), actions=1, rate=(1.0,))
