"""The first fault of a validation is one sentence for a person."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

from support.moody import SPEC
from surrogym_shared.faults import first_fault
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.spec.environment import ModelChoice


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"coordinates": []}, "coordinates: expected 1 or more entries, got 0"),
        ({"coordinates": 70 * [{}]}, "coordinates.0.name: expected a value, got nothing"),
        ({"starts": 257 * [[0.0]]}, "starts: expected at most 256 entries, got 257"),
        ({"time_limit": "long"}, "time_limit: expected a whole number"),
        ({"action": {"kind": "box", "low": [1.0], "high": [0.0]}}, "action.box: action 0 crosses: expected low < high"),
    ],
)
def test_a_validation_error_names_the_field_without_python_terms(fields: dict[str, Any], says: str):
    """``Tuple should have at least 1 item after validation`` and ``Value error,`` tell a person nothing."""
    with pytest.raises(ValidationError) as found:
        EnvironmentSpec.model_validate(SPEC.model_dump() | fields)
    assert first_fault(found.value).startswith(says)


def test_a_validation_error_shortens_a_long_value():
    with pytest.raises(ValidationError) as found:
        EnvironmentSpec.model_validate(SPEC.model_dump() | {"time_limit": 1_000 * "x"})
    said = first_fault(found.value, got=True)
    assert said.startswith("time_limit: expected a whole number, got 'xxx")
    assert len(said) < 120


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        (
            {"success": {"min_retrun": 1.0}},
            "success.min_retrun: unknown entry; expected some of hold, ",
        ),
        ({"colour": 1}, "colour: unknown entry; expected some of environment, coordinates, observation, action, start"),
        ({"design": {"bugdet": 3}}, "design.bugdet: unknown entry; expected some of preset, budget, "),
        (
            {"action": {"kind": "discrete", "n": 2, "bin": 3}},
            "action.discrete.bin: unknown entry; expected some of kind, n",
        ),
        (
            {"coordinates": [{"name": "x", "sampling": {"kind": "uniform", "low": 0.0, "hihg": 1.0}}]},
            "coordinates.0.sampling.uniform.hihg: unknown entry; expected some of kind, low, high; did you mean",
        ),
    ],
)
def test_a_validation_error_for_an_unknown_field_lists_the_allowed_ones(fields: dict[str, Any], says: str):
    """``Extra inputs are not permitted`` left a person to guess the name."""
    with pytest.raises(ValidationError) as found:
        EnvironmentSpec.model_validate(SPEC.model_dump() | fields)
    assert first_fault(found.value, of=EnvironmentSpec).startswith(says)


def test_a_validation_error_suggests_the_correct_name_of_a_misspelt_field():
    """A wrong name of a required entry gave ``Field required`` for the right one."""
    fields = SPEC.model_dump()
    fields["coordinate"] = fields.pop("coordinates")
    with pytest.raises(ValidationError) as found:
        EnvironmentSpec.model_validate(fields)
    said = first_fault(found.value, of=EnvironmentSpec)
    assert said.startswith("coordinate: unknown entry; expected some of environment, coordinates, ")
    assert said.endswith("; did you mean 'coordinates'?")


@pytest.mark.parametrize("given", [float("nan"), float("-inf"), None, [1], {"a": 1}])
def test_a_validation_error_for_a_setting_lists_all_allowed_types(given: object):
    """The error named one of four types, by a word of the library."""
    with pytest.raises(ValidationError) as refused:
        ModelChoice(name="ensemble", settings={"beta": given})
    said = first_fault(refused.value)
    assert said == f"settings.beta: expected a finite number, true, false or a text, got {given}"


def test_validated_settings_of_a_model_keep_their_types():
    settings = {"a": True, "b": 1, "c": 0.5, "d": "text"}
    assert ModelChoice(name="own", settings=settings).settings == settings
    assert [type(value) for value in ModelChoice(name="own", settings=settings).settings.values()] == [
        bool,
        int,
        float,
        str,
    ]
