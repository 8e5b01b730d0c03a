"""Rule: request real steps at the candidates with the largest value of the acquisition (eq. 13)."""

from __future__ import annotations

from surrogym_server.environment.points import Points
from surrogym_server.sampling.batch import choose
from surrogym_server.sampling.round import Round
from surrogym_shared.nouns import Query


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
