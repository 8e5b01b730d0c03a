"""Rule: plan action sequences (rollouts) in the model that maximise the acquisition's value along their paths."""

from __future__ import annotations

from surrogym_server.planning.sequences import policy_sequences
from surrogym_server.sampling.rollouts import STARTS, Aim, plan_round, start_points
from surrogym_server.sampling.round import Round
from surrogym_shared.nouns import Query

# If the environment has no snapshots, a round of planned action sequences has at least this many real steps.
SHORTEST = 4


def plan_rollouts(round: Round) -> tuple[Query, ...]:
    """Return action sequences (rollouts) that are planned in the model to give most information about the outputs whose
    confidence index is below the target.

    The value of a sequence is summed over these outputs. Sequences are not chosen from the candidates of single steps.
    If some of those are reserved, the first sequence should show an end of an episode or a jump of the reward. If
    the environment can only be reset, the search tries what the best policy on a coarse grid would do, as long as the
    model and the environment allow a grid.
    """
    request, judgement = round.request, round.judgement
    steps = min(round.room, steps_of_a_round(round)) if round.continues else request.extra
    longest = min(steps, round.definition.max_rollout or 1)
    tried = None
    if steps and not round.definition.snapshots:
        starts = start_points(round.definition, STARTS, round.generator())
        tried = policy_sequences(round.model, starts, longest, seek_end=False)
    aim = Aim(
        columns=round.outputs,
        tolerances=judgement.widened_tolerances,
        longest=longest,
        snapshots=request.snapshots,
        states=request.states,
        ending=judgement.candidates.reserved is not None,
        ended=bool(round.samples.terminated.any()),
        tried=tried,
    )
    return tuple(plan_round(round.model, aim, steps, request.unanswered, round.generator()))


def steps_of_a_round(round: Round) -> int:
    """Return the number of real steps of a planned round: a quarter of the number of samples, at least ``SHORTEST``
    (4). With snapshots it is an eighth of the samples, at least one step for each output below the target, because
    sequences need not lead away from a reset first.

    Rounds grow with the number of samples so that few fits are needed.
    """
    samples = len(round.samples)
    if round.definition.snapshots:
        return max(len(round.outputs), samples // 8)
    return max(SHORTEST, samples // 4)
