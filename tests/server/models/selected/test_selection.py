"""A family takes over an output only with a clear, honest and repeated advantage."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from surrogym_server.errors import InvalidInput
from surrogym_server.models.selected.selection import (
    Before,
    Evidence,
    Selection,
    Standing,
    decided,
    from_warm,
    warm_of,
)

NAMES = ("process", "networks", "lines")
HAD = Standing("process", 1.0, 0.0, 0.0, 0.90)
RIVAL = Standing("networks", 1.5, 0.5, 0.1, 0.88)
NEW = Before(("process",), ({},))


def serving(rival: Standing, before: Before = NEW) -> tuple[str, int]:
    """Who serves the only output after a comparison, and the comparisons that the rival has won in a row."""
    names, standings = decided(before, [[HAD, rival]], 2.0)
    return names[0], standings[0][1].wins


def test_a_family_takes_over_when_it_has_won_twice() -> None:
    assert serving(RIVAL) == ("process", 1)
    assert serving(RIVAL, Before(("process",), ({"networks": 1},))) == ("networks", 0)


@pytest.mark.parametrize(
    "rival",
    [
        replace(RIVAL, error=0.3),  # not by more than the margin
        replace(RIVAL, coverage=0.84),  # its intervals are too narrow
        replace(RIVAL, better=0.04, error=0.0),  # too little to matter
        replace(RIVAL, better=-0.5),
    ],
)
def test_a_comparison_that_is_not_won_ends_the_row(rival: Standing) -> None:
    assert serving(rival, Before(("process",), ({"networks": 1},))) == ("process", 0)


def test_the_first_comparison_decides_at_once() -> None:
    """Nothing has served before, so nothing can flap; a log may never be fitted twice."""
    assert serving(RIVAL, replace(NEW, first=True)) == ("networks", 0)


def test_the_best_of_several_winners_takes_over() -> None:
    before = Before(("process",), ({"networks": 1, "lines": 1},))
    best = Standing("lines", 2.0, 1.0, 0.1, 0.9)
    assert decided(before, [[HAD, RIVAL, best]], 2.0)[0] == ("lines",)


def test_outputs_are_decided_one_by_one_and_one_that_was_not_compared_stays() -> None:
    before = Before(("process", "process", "lines"), ({"networks": 1}, {}, {"networks": 1}))
    assert decided(before, [[HAD, RIVAL], [HAD, RIVAL], []], 2.0)[0] == ("networks", "process", "lines")


def test_a_choice_does_not_flap_where_families_are_equal() -> None:
    """Scores that waver about each other never move an output, because a win by luck does not come twice in a row."""
    before = NEW
    for better in (0.3, -0.3, 0.3, -0.3, 0.3):
        names, standings = decided(before, [[HAD, replace(RIVAL, better=better)]], 2.0)
        before = from_warm(NAMES, 1, warm_of(selection(names, standings)))
        assert before is not None
        assert before.serving == ("process",)


def selection(names: tuple[str, ...], standings: tuple[tuple[Standing, ...], ...]) -> Selection:
    return Selection(NAMES, names, Evidence("trajectories", 10, (1, 5), 2, ("lines failed: no",)), standings)


def test_the_state_survives_storage() -> None:
    whole = selection(("networks",), ((HAD, replace(RIVAL, wins=1)),))
    stored = json.loads(json.dumps({key: array.tolist() for key, array in warm_of(whole).items()}))
    before = from_warm(NAMES, 1, stored)
    assert before is not None
    assert (before.serving, before.wins[0]["networks"], before.first) == (("networks",), 1, False)
    assert Selection.from_json(json.loads(json.dumps(whole.to_json())), 1) == whole


def test_a_state_of_other_candidates_begins_anew() -> None:
    warm = warm_of(selection(("networks",), ((HAD, RIVAL),)))
    assert from_warm(("process",), 1, warm) is None
    assert from_warm(NAMES, 2, warm) is None
    assert from_warm(NAMES, 1, {}) is None


def test_a_stored_selection_of_unknown_families_is_refused() -> None:
    stored = selection(("networks",), ((HAD, RIVAL),)).to_json()
    with pytest.raises(InvalidInput, match="a family out of"):
        Selection.from_json(stored | {"serving": ["nobody"]}, 1)
    with pytest.raises(InvalidInput, match="finite scores"):
        Selection.from_json(stored | {"standings": [[stored["standings"][0][0] | {"score": float("inf")}]]}, 1)
