"""Rule: go a long way to a declared termination that no sample has shown."""

from __future__ import annotations

import math

from surrogym_server.sampling.round import Round
from surrogym_server.sampling.way_to_end import way_to_end
from surrogym_shared.nouns import Query


def seek_end(round: Round) -> tuple[Query, ...] | None:
    """Return an action sequence that probably ends the episode, or None if none is needed or known.

    The sequence may take more steps than a round has, up to the rest of the budget. None is sought before half as many
    adaptive steps as initial ones were taken, because a model of the initial steps alone is often wrong far away.
    """
    if not round.continues or round.cost < math.ceil(1.5 * round.definition.design.initial):
        return None
    way = way_to_end(round.model, round.samples, round.room, round.generator())
    return None if way is None else (way,)
