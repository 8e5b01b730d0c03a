"""Rule: query the candidates with the largest value of the acquisition (eq. 13)."""

from __future__ import annotations

from surrogym_server.environment.points import Points
from surrogym_server.sampling.batch import choose
from surrogym_server.sampling.round import Round
from surrogym_shared.nouns import Query


def ask_best_candidates(round: Round) -> tuple[Query, ...]:
    """Return one query for each output below its target, the least confident output first.

    If candidates are reserved (see ``Candidates``), the first query is one of them.
    """
    below, judgement = round.below_target, round.judgement
    unanswered = Points.of(round.definition, round.request.unanswered)
    if round.continues:
        outputs = below[: round.room]
    else:
        outputs = [below[i % len(below)] for i in range(round.request.extra)]
    earlier = Points.joined([Points(round.samples.q, round.samples.u), unanswered])
    candidates = judgement.candidates
    picks = choose(round.model, candidates, earlier, unanswered, outputs, judgement.tolerances)
    return candidates.points[picks].queries
