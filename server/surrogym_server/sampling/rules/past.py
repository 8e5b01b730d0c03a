"""Rule: take consecutive steps that show whether an error is noise or depends on the steps before."""

from __future__ import annotations

from surrogym_server.sampling.judging import agrees
from surrogym_server.sampling.past import pairs_lacking
from surrogym_server.sampling.rollouts import random_sequences
from surrogym_server.sampling.round import Round
from surrogym_shared.nouns import Query

LENGTH = 8  # number of actions in each random sequence that ``see_the_past`` requests, if the environment allows it


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
