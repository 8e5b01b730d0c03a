"""A family takes over an output only with a clear, honest and repeated advantage."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch

from surrogym_server.errors import InvalidInput
from surrogym_server.models.selected.learning import compared
from surrogym_server.models.selected.scores import Scores
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
        replace(RIVAL, coverage_error=0.02),  # too few pieces show that they are not: 2 + 2 * 2 points may be lost
        replace(RIVAL, better=0.04, error=0.0),  # too little to matter
        replace(RIVAL, better=-0.5),
    ],
)
def test_a_comparison_that_is_not_won_ends_the_row(rival: Standing) -> None:
    assert serving(rival, Before(("process",), ({"networks": 1},))) == ("process", 0)


def test_coverage_that_is_known_well_enough_is_lost_by_at_most_five_points() -> None:
    """The rival is inside by 2 points less, and 2 standard errors of 1.5 points more are still allowed, not of 1.6."""
    before = Before(("process",), ({"networks": 1},))
    assert serving(replace(RIVAL, coverage_error=0.015), before)[0] == "networks"
    assert serving(replace(RIVAL, coverage_error=0.016), before)[0] == "process"
    wider = replace(RIVAL, coverage=0.97, coverage_error=0.05)
    assert serving(wider, before)[0] == "networks", "a rival with wider intervals needs fewer pieces"


def test_a_margin_of_zero_asks_for_no_certainty() -> None:
    before = Before(("process",), ({"networks": 1},))
    assert decided(before, [[HAD, replace(RIVAL, error=9.0, coverage_error=9.0)]], 0.0)[0] == ("networks",)


def test_errors_are_those_over_pieces() -> None:
    """Of 16 pieces four lose all intervals: a quarter of the coverage, with the standard error of 16 values."""
    inside, density = torch.ones(16), torch.zeros(16)
    narrow = torch.where(torch.arange(16) < 4, 0.0, inside)
    found = compared("networks", Scores(density, narrow), Scores(density, inside))
    assert found.coverage == 0.75
    assert found.coverage_error == pytest.approx(float(narrow.std()) / 4)
    assert compared("process", Scores(density, inside), Scores(density, inside)).coverage_error == 0


def test_a_stored_selection_without_errors_of_coverage_is_read() -> None:
    """Files of versions before this error was known stay readable."""
    stored = selection(("networks",), ((HAD, RIVAL),)).to_json()
    for one in stored["standings"][0]:
        del one["coverage_error"]
    assert Selection.from_json(stored, 1).standings[0][1] == RIVAL


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
