"""Test a model that is sure, far away from all samples."""

from __future__ import annotations

import torch

from surrogym_server.sampling.excursions import excursion
from surrogym_server.sampling.round import Round
from surrogym_shared.nouns import Query


def take_excursion(round: Round) -> tuple[Query, ...] | None:
    """Take an excursion, if the budget has room for it."""
    if not round.testing:
        return None
    if not round.room:
        return ()
    visited = torch.cat([round.samples.q, round.samples.q_next])
    return (excursion(round.model, visited, round.request.snapshots, round.room, round.generator()),)
