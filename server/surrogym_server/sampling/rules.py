"""Rules that choose the real steps that a round of the design requests (queries). The first that applies chooses."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch

from surrogym_server.environment.points import Points
from surrogym_server.models.guard import plugin_calls
from surrogym_server.planning.planner import allows_planning
from surrogym_server.planning.sequences import policy_sequences
from surrogym_server.sampling.batch import choose
from surrogym_server.sampling.excursions import excursion
from surrogym_server.sampling.judging import agrees
from surrogym_server.sampling.noise import to_repeat
from surrogym_server.sampling.past import pairs_lacking
from surrogym_server.sampling.rollouts import STARTS, Aim, first_rollouts, plan_round, random_sequences, start_points
from surrogym_server.sampling.round import Round
from surrogym_server.sampling.way_to_end import way_to_end
from surrogym_shared.nouns import Query

# If the environment has no snapshots, a round of planned action sequences has at least this many real steps.
SHORTEST = 4
SHARE = 3  # a rollout of ``try_planner`` has one step for each such number of samples
STEPS = 10  # real steps before trials of policies, for each coordinate and each action entry
LENGTH = 8  # number of actions in each random sequence that ``see_the_past`` requests, if the environment allows it


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


def ask_best_candidates(round: Round) -> tuple[Query, ...]:
    """Return one query (a real step to request) for each output whose confidence index is below the target, the lowest
    first, as far as the budget allows: the candidate with the largest value of the acquisition.

    If the design has ended, return as many queries as a person has requested (``request.extra``), for the outputs below
    the target in turn. If some candidates are reserved (see ``Candidates``), the first query is one of them.
    """
    judgement = round.judgement
    unanswered = Points.of(round.definition, round.request.unanswered)
    if round.continues:
        outputs = round.outputs[: round.room]
    else:
        outputs = [round.outputs[i % len(round.outputs)] for i in range(round.request.extra)]
    earlier = Points.joined([Points(round.samples.q, round.samples.u), unanswered])
    candidates = judgement.candidates
    picks = choose(round.model, candidates, earlier, unanswered, outputs, judgement.widened_tolerances)
    return candidates.points[picks].queries


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


def see_the_past(round: Round) -> tuple[Query, ...] | None:
    """Return random action sequences if a leave-one-out error exceeds its tolerance and there are too few consecutive
    steps to test whether earlier steps explain the error (``sampling.past``). Otherwise return None.

    The result is always None for an environment with snapshots, because a snapshot contains the whole state, also the
    hidden part.
    """
    definition, judgement = round.definition, round.judgement
    if not round.may_examine or definition.snapshots or round.request.pending:
        return None
    if all(agrees(c, t) for c, t in zip(judgement.confidences[:-1], judgement.widened_tolerances, strict=False)):
        return None
    length = min(LENGTH, definition.max_rollout or 1)
    if length < 2:
        return None
    lacking = pairs_lacking(definition, round.samples)
    count = min(-(-lacking // (length - 1)), round.room // length)
    if not count:
        return None
    sequences = random_sequences(definition, count, length, round.generator())
    return tuple(map(Query.rollout, sequences.tolist()))


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


def seek_end(round: Round) -> tuple[Query, ...] | None:
    """Return an action sequence that probably ends the episode, or None if none is needed or known.

    The sequence may take more steps than a round has, up to the rest of the budget. None is sought before half as many
    adaptive steps as initial ones were taken, because a model of the initial steps alone is often wrong far away.
    """
    if not round.continues or round.cost < math.ceil(1.5 * round.definition.design.initial):
        return None
    way = way_to_end(round.model, round.samples, round.room, round.generator())
    return None if way is None else (way,)


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


Rule = Callable[[Round], tuple[Query, ...] | None]
"""Function that returns the queries of a round, or (), which ends the design if no earlier query is open. If it returns
None, the next rule is tried."""

# Rules for an environment that can be set to any state, whose queries are single steps.
STEP_RULES: tuple[Rule, ...] = (repeat_steps, ask_best_candidates)

# Rules for an environment that can only begin at resets or snapshots, whose queries are action sequences.
ROLLOUT_RULES: tuple[Rule, ...] = (
    take_excursion,
    see_the_past,
    complete_initial_rollouts,
    leave_to_trials,
    seek_end,
    try_planner,
    plan_rollouts,
)
