"""What a specification of a log may say, and what contradicts itself."""

from __future__ import annotations

import pytest

from support import pendulum
from surrogym_shared.spec import EnvironmentSpec


def spec(**changes) -> EnvironmentSpec:
    return EnvironmentSpec.model_validate(pendulum.spec() | changes)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"starts": [[0.0]]}, "starts: expected 2 entries, got 1"),
        ({"starts": [[0.0, float("inf")]]}, "finite"),
        ({"starts": [[0.0, 0.0]] * 257}, "at most 256"),
        ({"outside_reward": -1.0, "time_limit": None}, "outside_reward is paid for each step up to the time limit"),
        ({"design": {"budget": 1}}, "expected a budget of 2 or more real steps, or 0 for none, got 1"),
    ],
)
def test_a_contradicting_specification_of_a_log_is_refused(changes: dict, says: str):
    with pytest.raises(ValueError, match=says):
        spec(**changes)


def test_a_specification_with_budget_0_accepts_any_number_of_initial_queries():
    assert spec(design={"budget": 0, "initial": 5}).design.budget == 0
