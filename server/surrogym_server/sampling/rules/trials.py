"""Rule: in every second round, act by a planner on the model, so that the steps lead where a policy goes."""

from __future__ import annotations

from surrogym_server.planning.planner import allows_planning
from surrogym_server.planning.sequences import policy_sequences
from surrogym_server.sampling.rollouts import start_points
from surrogym_server.sampling.round import Round
from surrogym_server.sampling.rules.planned import SHORTEST
from surrogym_shared.nouns import Query

SHARE = 3  # a rollout has one step for each such number of samples


def try_planner(round: Round) -> tuple[Query, ...] | None:
    """Return one rollout from a reset whose actions the sampler plans anew at each step, or None if this is not its
    round, or if the model or the environment does not allow planning.

    A sequence of actions that was planned beforehand leaves an unstable state, such as an upright pole, as soon as the
    model is a little wrong. A planner comes back to it. The rollout has a third of the number of samples as steps.
    """
    definition, model = round.definition, round.model
    steps = min(round.room, definition.max_rollout or 1, max(SHORTEST, len(round.samples) // SHARE))
    if not round.continues or round.number % 2 == 0 or definition.snapshots or definition.unknown_steps or steps < 1:
        return None
    if not allows_planning(model):
        return None
    expected = policy_sequences(model, start_points(definition, 1, round.generator()), steps, seek_end=False)
    return None if expected is None else (Query.rollout(expected[0].tolist(), replan=True),)
