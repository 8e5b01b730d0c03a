"""Plan rollouts in the model, by the acquisition's value along their paths."""

from __future__ import annotations

from surrogym_server.sampling.rollouts import Aim, plan_round
from surrogym_server.sampling.round import Round
from surrogym_shared.nouns import Query

SHORTEST = 4  # real steps of a round


def plan_rollouts(round: Round) -> tuple[Query, ...]:
    """Plan rollouts for the outputs below their target."""
    request, judgement = round.request, round.judgement
    aim = Aim(
        columns=round.below_target,
        tolerances=judgement.tolerances,
        longest=round.definition.max_rollout or 1,
        snapshots=request.snapshots,
        states=request.states,
        ending=judgement.candidates.reserved is not None,
        ended=bool(round.samples.terminated.any()),
    )
    steps = min(round.room, steps_of_a_round(round)) if round.continues else request.extra
    return tuple(plan_round(round.model, aim, steps, request.unanswered, round.generator()))


def steps_of_a_round(round: Round) -> int:
    """Return a quarter as many real steps as there are samples, so that plans become longer and fits are few.

    With snapshots, which need no way from a reset, it is half as many, and at least one for each output below its
    target, as with single steps.
    """
    samples = len(round.samples)
    if round.definition.snapshots:
        return max(len(round.below_target), samples // 8)
    return max(SHORTEST, samples // 4)
