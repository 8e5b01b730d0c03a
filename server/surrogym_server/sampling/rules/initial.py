"""Complete an initial design whose rollouts ended early."""

from __future__ import annotations

from surrogym_server.sampling.rollouts import Rollout, first_rollouts
from surrogym_server.sampling.round import Round
from surrogym_server.sampling.rules.planned import steps_of_a_round
from surrogym_server.sampling.rules.rule import Chosen


def complete_initial_rollouts(round: Round) -> Chosen | None:
    """Take further random rollouts, if more steps of the initial design are missing than a planned round has.

    Otherwise many small rounds would follow, each with a fit to few steps. Logged steps can replace initial ones.
    """
    if not round.continues or round.definition.snapshots:
        return None
    initial = round.definition.design.initial
    pending = sum(map(len, round.request.pending_rollouts))
    missing = min(initial - round.spent - min(round.request.logged, initial) - pending, round.room)
    if missing <= steps_of_a_round(round):
        return None
    return Chosen(rollouts=tuple(map(Rollout, first_rollouts(round.definition, missing, round.generator()))))
