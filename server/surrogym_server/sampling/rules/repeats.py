"""Rule: take earlier steps again, to distinguish noise of the environment from misfit of the model."""

from __future__ import annotations

from surrogym_server.models.guard import plugin_calls
from surrogym_server.sampling.noise import to_repeat
from surrogym_server.sampling.round import Round
from surrogym_shared.nouns import Query


def repeat_steps(round: Round) -> tuple[Query, ...] | None:
    """Return queries that repeat earlier steps if these are needed to tell noise from misfit of the model and if budget
    is left, otherwise None."""
    if not round.may_examine:
        return None
    with plugin_calls(round.definition):
        again = to_repeat(round.model, round.samples, round.tolerances)
    if again is None or not round.room:
        return None
    return again[: round.room].queries
