"""Checking what a stranger sent stops at the first wrong entry of a list, however deep it stands."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import BaseModel, ValidationError

from surrogym_shared import wire

WRONG: list[tuple[type[BaseModel], dict[str, Any]]] = [
    (wire.StepSession, {"action": [["", ""]] * 50_000}),
    (wire.ResetSession, {"mask": [""] * 50_000}),
    (wire.Points, {"coordinates": [[""]] * 50_000, "action": [[0.0]]}),
    (wire.AddSamples, {"sampler": "x", "samples": [{}] * 50_000}),
    (wire.CreateSurrogate, {"name": "x", "spec": {"coordinates": [{}] * 50_000}}),
    (wire.CreateSurrogate, {"name": "x", "spec": {"observation": [{"name": "a", "term": {"parts": [{}] * 50_000}}]}}),
]


@pytest.mark.parametrize(("model", "body"), WRONG)
def test_validation_stops_at_the_first_wrong_list_entry(model: type[BaseModel], body: dict[str, Any]):
    with pytest.raises(ValidationError) as refused:
        model.model_validate(body)
    assert refused.value.error_count() < 16


def test_a_valid_request_body_is_read_completely():
    assert len(wire.StepSession(action=[[0.5]] * 1_000).action) == 1_000
