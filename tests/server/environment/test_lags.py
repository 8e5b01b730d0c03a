"""Lags repeat the past exactly, without a process."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from pydantic import ValidationError

from surrogym_server.convert import definition_from_spec
from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.step_rules import with_lags
from surrogym_shared.spec import EnvironmentSpec

WIDE = {"kind": "uniform", "low": -4.0, "high": 4.0}
ANGLE = {"name": "angle", "kind": "angle", "sampling": WIDE}
LEVEL = {"name": "level", "sampling": WIDE}
LAGS = {
    "turned": {"kind": "change", "of": "angle"},
    "risen": {"kind": "change", "of": "level"},
    "risen before": {"kind": "value", "of": "risen"},
    "level before": {"kind": "value", "of": "level"},
    "second": {"kind": "action", "entry": 1},
}


def described(**lags: dict[str, Any]) -> dict[str, Any]:
    coordinates = [ANGLE, LEVEL, *({"name": n, "sampling": WIDE, "lag": lag} for n, lag in lags.items())]
    return {
        "coordinates": coordinates,
        "observation": [{"name": "level", "term": {"parts": [{"function": "linear", "weights": {"level": 1}}]}}],
        "action": {"kind": "box", "low": [-1.0, -1.0], "high": [1.0, 1.0]},
        "start": {c["name"]: WIDE for c in coordinates},
        "query": "rollout",
    }


def defined(**lags: dict[str, Any]) -> EnvironmentDefinition:
    return definition_from_spec(EnvironmentSpec.model_validate(described(**lags)))


def test_each_kind_of_lagged_coordinate_has_the_past_value_of_its_source():
    definition = defined(**LAGS)
    q = torch.tensor([[3.0, 1.0, 9.0, 0.5, 9.0, 9.0, 9.0]], dtype=torch.float64)
    u = torch.tensor([[0.25, -0.75]], dtype=torch.float64)
    arrived = torch.tensor([[-3.0, 1.2, 0.0, 0.0, 0.0, 0.0, 0.0]], dtype=torch.float64)
    reached = with_lags(definition, q, u, arrived)[0]
    torch.testing.assert_close(reached[2:], torch.tensor([2 * math.pi - 6, 0.2, 0.5, 1.0, -0.75], dtype=torch.float64))
    assert reached[:2].tolist() == [-3.0, 1.2]
    assert not arrived[0, 2:].any()


def test_a_step_counter_coordinate_stops_at_its_upper_bound():
    definition = definition_from_spec(EnvironmentSpec.model_validate(counting(2.0)))
    q, still = torch.zeros(1, 3, dtype=torch.float64), torch.zeros(1, 2, dtype=torch.float64)
    known = []
    for _ in range(4):
        known.append(bool(definition.known(q)))
        q = with_lags(definition, q, still, q)
    assert known == [False, False, True, True]
    assert q[0, 2] == 2


def counting(high: float | None) -> dict[str, Any]:
    fields = described(steps={"kind": "steps"})
    fields["coordinates"][2] |= {
        "sampling": {"kind": "uniform", "low": 0.0, "high": 2.0},
        "bounds": {"low": 0.0, "high": high},
    }
    fields["start"]["steps"] = {"kind": "fixed", "value": 2.0}
    return fields


def test_a_step_counter_coordinate_without_upper_bound_is_refused():
    with pytest.raises(ValidationError, match="needs an upper bound above 0"):
        EnvironmentSpec.model_validate(counting(None))


def test_two_step_counter_coordinates_are_refused():
    fields = counting(2.0)
    second = fields["coordinates"][2] | {"name": "again"}
    fields |= {"coordinates": [*fields["coordinates"], second], "start": fields["start"] | {"again": WIDE}}
    with pytest.raises(ValidationError, match="expected one coordinate of kind 'steps', got two"):
        EnvironmentSpec.model_validate(fields)


def test_the_model_does_not_predict_lagged_coordinates():
    assert defined(**LAGS).outputs == ("angle", "level", "reward")


@pytest.mark.parametrize(
    ("lag", "message"),
    [
        ({"kind": "change", "of": "nothing"}, "of an earlier coordinate"),
        ({"kind": "value", "of": "angle"}, "lags of an angle are of kind 'change'"),
        ({"kind": "action", "entry": 2}, "expected an entry below 2, got 2"),
        ({"kind": "action", "of": "level"}, "expected 'entry' without 'of'"),
        ({"kind": "change"}, "expected 'of' without 'entry'"),
        ({"kind": "steps", "of": "level"}, "expected neither 'entry' nor 'of'"),
    ],
)
def test_a_lagged_coordinate_without_a_source_is_refused(lag, message):
    with pytest.raises(ValidationError, match=message):
        EnvironmentSpec.model_validate(described(lagged=lag))


def test_lagged_coordinates_are_refused_for_environments_with_settable_states():
    with pytest.raises(ValidationError, match=r"has no past, .* expected query 'rollout', got 'step'"):
        EnvironmentSpec.model_validate(described(**LAGS) | {"query": "step"})


@pytest.mark.parametrize("limit", ["time_limit", "max_rollout"])
def test_a_lag_longer_than_an_episode_is_refused(limit):
    lags = {"u1": {"kind": "action", "entry": 0}, "u2": {"kind": "value", "of": "u1"}}
    assert EnvironmentSpec.model_validate(described(**lags) | {limit: 3})
    with pytest.raises(ValidationError, match="looks 2 steps back: expected fewer than an episode's 2"):
        EnvironmentSpec.model_validate(described(**lags) | {limit: 2})
