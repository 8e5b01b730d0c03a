"""Phases in which a design has ended, and surrogates whose design waits for a log."""

from __future__ import annotations

from surrogym_shared.states import COMPLETED as COMPLETED
from surrogym_shared.states import ENDED as ENDED
from surrogym_shared.states import Phase
from surrogym_shared.wire import SurrogateView

IN_WORDS: dict[Phase, str] = {
    "ready": "the design is ready",
    "over_budget": "the design has spent its budget without being certain of its model",
    "unsure": "the design has ended before its budget was spent, without being certain of its model",
    "from_log": "the model is fitted to the log, and the design requests no real steps",
    "failed": "the design has failed",
}


def awaits_log(view: SurrogateView) -> bool:
    """Whether a design waits for the import of a log: its budget is 0, and it has neither samples nor queries."""
    asked = view.queries.pending + view.queries.leased
    return view.budget == 0 and view.model_version is None and not view.samples and not asked


def words_of_no_log(name: str) -> str:
    """Describe the state of a surrogate that waits for a log, with the command that imports one."""
    return f"the design requests no real steps, and there is no log yet; next: surrogym import LOG --to {name}"
