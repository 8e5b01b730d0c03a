"""Surrogates are created once: the same specification again is harmless, another one is told apart in words."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from surrogym_server.convert import resources
from surrogym_server.errors import SpecConflict
from surrogym_server.services.activity import Samplers
from surrogym_server.services.definitions import Definitions
from surrogym_server.services.surrogates import READS, SurrogateService, check_same
from surrogym_server.storage.sql import Storage

NAME = "pendulum"


class NoSessions:
    """An engine without sessions."""

    def counts(self) -> Any:
        return SimpleNamespace(sessions={})


def test_a_status_read_while_the_design_fails_contains_the_error(
    storage: Storage, definitions: Definitions, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = storage.surrogates.get

    def fails_afterwards(name: str) -> Any:
        record = read(name)
        storage.surrogates.set_phase(name, "failed", "no power")
        return record

    monkeypatch.setattr(storage.surrogates, "get", fails_afterwards)
    view = resources.surrogate_view(service(storage, definitions).status(NAME))
    assert (view.phase, view.error) == ("failed", "no power")


@pytest.mark.parametrize("changes", [1, READS - 1])
def test_a_status_read_during_changes_is_consistent(
    storage: Storage, definitions: Definitions, monkeypatch: pytest.MonkeyPatch, changes: int
) -> None:
    """Each of its first reads is followed by a change of the budget, as if another request came in between."""
    read, budgets = storage.designs.left, [50 + change for change in range(changes)]

    def changed_afterwards(name: str) -> int:
        left = read(name)
        if budgets:
            storage.surrogates.change(name, budget=budgets.pop())
        return left

    monkeypatch.setattr(storage.designs, "left", changed_afterwards)
    status = service(storage, definitions).status(NAME)
    assert not budgets
    assert (status.budget_left, status.summary.budget) == (read(NAME), 50)


def service(storage: Storage, definitions: Definitions) -> SurrogateService:
    unused: Any = None
    engine: Any = NoSessions()
    return SurrogateService(storage, definitions, unused, unused, unused, engine, unused, Samplers())


@pytest.mark.parametrize(
    ("other", "words"),
    [
        ({"x": [{"low": 2}], "y": None}, r"x\.0\.low was created as 1, got 2"),
        ({"x": [], "y": None}, r'x was created as \[{"low": 1}\], got \[\]'),
        ({"x": [{"low": 1}]}, "y was created as null, got nothing"),
        ({"x": [{"low": 1}], "y": None, "z": "a" * 500}, "z was created as nothing, got "),
    ],
)
def test_another_specification_under_the_same_name_is_refused_with_the_difference(
    other: dict[str, Any], words: str
) -> None:
    spec = {"x": [{"low": 1}], "y": None}
    check_same("a", spec, spec)
    with pytest.raises(SpecConflict, match=f"^surrogate 'a' exists with another specification: {words}") as refused:
        check_same("a", spec, other)
    assert len(str(refused.value)) < 250
