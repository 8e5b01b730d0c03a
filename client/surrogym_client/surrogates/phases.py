"""Phases in which a design has ended."""

from __future__ import annotations

from surrogym_shared.wire import Phase

COMPLETED: tuple[Phase, ...] = ("ready", "over_budget", "from_log")  # the model will not improve by itself
ENDED: tuple[Phase, ...] = (*COMPLETED, "failed")  # a sampler has nothing left to do
IN_WORDS: dict[Phase, str] = {
    "ready": "the design is ready",
    "over_budget": "the design has ended without being certain of its model",
    "from_log": "the model is fitted to the log, and the design requests no real steps",
    "failed": "the design has failed",
}
