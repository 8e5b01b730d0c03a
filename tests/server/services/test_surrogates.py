"""Surrogates are created once: the same specification again is harmless, another one is told apart in words."""

from __future__ import annotations

from typing import Any

import pytest

from surrogym_server.errors import SpecConflict
from surrogym_server.services.surrogates import check_same


@pytest.mark.parametrize(
    ("other", "words"),
    [
        ({"x": [{"low": 2}], "y": None}, r"x\.0\.low was created as 1, got 2"),
        ({"x": [], "y": None}, r'x was created as \[{"low": 1}\], got \[\]'),
        ({"x": [{"low": 1}]}, "y was created as null, got nothing"),
        ({"x": [{"low": 1}], "y": None, "z": "a" * 500}, "z was created as nothing, got "),
    ],
)
def test_another_spec_under_the_same_name_is_refused(other: dict[str, Any], words: str) -> None:
    spec = {"x": [{"low": 1}], "y": None}
    check_same("a", spec, spec)
    with pytest.raises(SpecConflict, match=f"^'a' exists with another specification: {words}") as refused:
        check_same("a", spec, other)
    assert len(str(refused.value)) < 250
