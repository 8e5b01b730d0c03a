"""The comparison of families in words and rows, as commands and the report show it."""

from __future__ import annotations

from typing import Any

import pytest

from surrogym_client.original.classic import pendulum
from surrogym_client.surrogates.compared import HEADING, rows_of, said_of, selection_of
from surrogym_shared.spec import ModelChoice


def standing(family: str, better: float, wins: int = 0) -> dict[str, Any]:
    return {"family": family, "score": 1.0 + better, "better": better, "error": 0.1, "coverage": 0.9, "wins": wins}


def selection(**held: Any) -> dict[str, Any]:
    usual = {"kind": "trajectories", "pieces": 10, "horizons": [1, 5, 20], "folds": 5, "notes": ["lines failed: no"]}
    return {
        "serving": ["process", "process"],
        "held_out": usual | held,
        "standings": [[standing("process", 0.0), standing("networks", 0.4, 1)], []],
    }


def test_words_say_what_was_held_out_and_what_was_not_compared() -> None:
    assert said_of(selection()) == (
        "families compared on 10 held-out pieces of trajectories, predicted 1 and 5 and 20 steps ahead, each fitted "
        "5 times without them (score: log density in nats; higher is better):\nlines failed: no"
    )
    single = said_of(selection(kind="steps", horizons=[1], folds=1, notes=[]))
    assert "10 held-out single steps, predicted 1 step ahead, each fitted once" in single
    assert said_of(selection(kind="none", pieces=0, notes=["too few"])) == "too few"


def test_each_rival_has_a_row_and_an_output_without_rivals_too() -> None:
    rows = rows_of(selection(), ["place", "reward"])
    assert all(len(row) == len(HEADING) for row in rows)
    assert rows == [
        ("place", "process", "serves", 1.0, 0.0, 0.1, 0.9, 0),
        ("place", "networks", "", 1.4, 0.4, 0.1, 0.9, 1),
        ("reward", "process", "serves", None, None, None, None, None),
    ]


@pytest.mark.parametrize(("model", "found"), [("Selected", True), ("ensemble", False), (None, False)])
def test_only_the_family_that_compares_is_read_so(model: str | None, found: bool) -> None:
    """Another family's description may have an entry of the same name."""
    for choice in (model, None if model is None else ModelChoice(name=model)):
        design = pendulum().design.model_copy(update={"model": choice})
        spec = pendulum().model_copy(update={"design": design})
        assert (selection_of(spec, {"selection": selection()}) is not None) == found
