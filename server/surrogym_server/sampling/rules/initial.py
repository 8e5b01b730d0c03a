"""Rule: request the real steps that are missing in the initial design because its action sequences ended early."""

from __future__ import annotations

from surrogym_server.sampling.rollouts import first_rollouts
from surrogym_server.sampling.round import Round
from surrogym_server.sampling.rules.planned import steps_of_a_round
from surrogym_shared.nouns import Query


def complete_initial_rollouts(round: Round) -> tuple[Query, ...] | None:
    """Return further random action sequences (rollouts) if the initial design lacks more steps than a planned round
    would take, otherwise None.

    The initial design lacks steps if episodes ended before the end of its sequences. Without this rule many small
    rounds would follow, each with a fit to few samples. Steps from a log count as steps of the initial design.
    """
    if not round.continues or round.definition.snapshots:
        return None
    initial = round.definition.design.initial
    request = round.request
    missing = min(initial - round.cost - min(request.logged, initial) - request.pending_steps, round.room)
    if missing <= steps_of_a_round(round):
        return None
    return first_rollouts(round.definition, missing, round.generator())
