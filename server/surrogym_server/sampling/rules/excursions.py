"""Rule: before a design is ready, test its model by an excursion: an action sequence away from all samples."""

from __future__ import annotations

import torch

from surrogym_server.sampling.excursions import excursion
from surrogym_server.sampling.round import Round
from surrogym_shared.nouns import Query


def take_excursion(round: Round) -> tuple[Query, ...] | None:
    """Return an excursion (an action sequence that leads far away from all samples) as the next query. Return None if
    the model need not be tested by an excursion, and () if no budget is left for an excursion, or if queries are still
    open, among which may be an excursion."""
    if not round.testing or not round.definition.snapshots:
        return None
    if not round.room or round.request.open:
        return ()
    states = torch.cat([round.samples.q, round.samples.q_next])
    return (excursion(round.model, states, round.request.snapshots, round.room, round.generator()),)
