"""Waiting for a model: a long fit is counted in seconds, and one that outlasts the wait is said to continue."""

from __future__ import annotations

from typing import Any
from unittest.mock import Mock

import pytest

from surrogym_client.surrogates import waiting
from surrogym_client.surrogates.waiting import DesignUnfinished, is_fitting, wait_for_model, words_of_long_fit
from surrogym_shared.wire import Ledger, QueryCounts


def view(phase: str, samples: int = 2_000) -> Any:
    ledger, outputs = Ledger(logged=samples), [*(f"x{number}" for number in range(7)), "reward"]
    return Mock(phase=phase, samples=samples, budget=0, ledger=ledger, fidelity=None, outputs=outputs)


def test_waiting_for_a_model_shows_the_seconds_of_the_running_fit():
    said = words_of_long_fit(view("fitting"), 12.3)
    assert "a model is being fitted to 2000 steps for 12 s" in said
    assert "8 outputs take 8 to 240 s of a free core" in said
    assert "noise" not in words_of_long_fit(view("fitting", samples=40), 12.3)
    assert words_of_long_fit(view("from_log"), 12.3) == "2000 logged steps"


@pytest.mark.parametrize(("phase", "said"), [("fitting", "continues on the server"), ("sampling", "phase is sampling")])
def test_waiting_that_times_out_reports_that_the_fit_continues(monkeypatch: pytest.MonkeyPatch, phase: str, said: str):
    monkeypatch.setattr(waiting, "LOOK_SECONDS", 0.0)
    api: Any = Mock(surrogate=lambda _: view(phase))
    with pytest.raises(DesignUnfinished, match=said):
        wait_for_model(api, "tank", 0.01)


def test_a_first_fit_that_waits_for_its_turn_counts_as_running():
    """train said that there was no model yet, while the fits of other surrogates ran before that of this one."""
    due: Any = view("collecting")
    due.paused, due.queries = False, QueryCounts(answered=4)
    assert is_fitting(due)
    due.queries = QueryCounts(answered=4, pending=1)
    assert not is_fitting(due), "a sampler has to answer the other query first"
    due.queries, due.paused = QueryCounts(answered=4), True
    assert not is_fitting(due), "a paused design fits no model"
