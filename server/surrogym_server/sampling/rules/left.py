"""Rule: leave the rest of the budget to trials of trained policies, where no other rule can steer the machine."""

from __future__ import annotations

from surrogym_server.sampling.round import Round
from surrogym_shared.nouns import Query

STEPS = 10  # real steps before trials, for each coordinate and each action entry


def leave_to_trials(round: Round) -> tuple[Query, ...] | None:
    """Return no query once the model is good enough to train a policy, if the environment can only be reset and a
    planner can't act in it; otherwise None.

    Sequences of actions hardly reach the states that a good policy visits. The trials of policies (``surrogym train``)
    reach them, and their steps count towards the budget. If limits are declared, such a policy was trained to keep away
    from them, and the sampler keeps them in its trial.
    """
    definition, size = round.definition, len(round.definition.coordinates)
    if not definition.design.trials or not round.continues or round.testing:
        return None
    if round.cost < STEPS * (size + definition.action.size):
        return None
    return ()
