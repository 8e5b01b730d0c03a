"""What a specification may say of an environment that can only be reset and acted on."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from surrogym_sampler.original.classic import pendulum
from surrogym_shared.spec import EnvironmentSpec


def changed(**changes: object) -> EnvironmentSpec:
    return EnvironmentSpec.model_validate({**pendulum().model_dump(), **changes})


def test_a_specification_declares_settable_states_by_default() -> None:
    assert pendulum().query == "step"
    assert changed(query="rollout", max_rollout=50).max_rollout == 50


@pytest.mark.parametrize(
    ("changes", "access"),
    [({}, "any"), ({"query": "rollout", "snapshots": True}, "snapshot"), ({"query": "rollout"}, "reset")],
)
def test_the_access_mode_of_a_specification_follows_from_query_and_snapshots(
    changes: dict[str, object], access: str
) -> None:
    assert changed(**changes).access == access


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"max_rollout": 5}, r"max_rollout 5 needs query 'rollout' \(--access reset or snapshot\), got 'step'"),
        ({"query": "rollout", "design": {"preset": "paper"}}, "Latin hypercube of states: expected query 'step'"),
        ({"query": "rollout", "max_rollout": 0}, "greater than or equal to 1"),
        ({"query": "rollout", "max_rollout": 5000}, "less than or equal to 4096"),
        ({"snapshots": True}, "snapshots need query 'rollout', got 'step'"),
        ({"query": "teleport"}, "'step' or 'rollout'"),
    ],
)
def test_contradicting_access_settings_of_a_specification_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        changed(**changes)
