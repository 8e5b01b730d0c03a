"""Greedy batches of queries from a candidate set, by an acquisition (eq. 13)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.features import distances
from surrogym_server.environment.points import Points
from surrogym_server.models.abilities import OutputOutlook
from surrogym_server.models.port import DynamicsModel
from surrogym_server.sampling.acquisition import CandidateView, acquisition_of, value_of
from surrogym_server.sampling.candidates import Candidates
from surrogym_server.sampling.outlook import outlook_of

NEAR = 0.02  # queries closer than this, in standard deviations of the sampling range, are near-duplicates


def choose(
    model: DynamicsModel,
    candidates: Candidates,
    earlier: Points,
    unanswered: Points,
    outputs: Sequence[int],
    tolerances: Sequence[float],
) -> list[int]:
    """Choose a greedy batch: for each of the ``outputs`` the best candidate, given answers to those chosen before it.

    Args:
        model: the model whose standard deviations the batch should lower.
        candidates: points to choose from; the first query is a reserved one, if there is one.
        earlier: all queries so far, answered or not; no query close to one of them is chosen.
        unanswered: those without an answer, which are treated as answered.
        outputs: for each query, the number of the output that it is chosen for.
        tolerances: (O,) in each output's unit.

    Returns:
        Indices of candidates; fewer than ``outputs`` if no distinct candidate is left.
    """
    definition, points = model.definition, candidates.points
    acquisition = definition.design.acquisition
    # The covariances of the reference cost the most.
    reads = acquisition_of(acquisition).reads_reference
    reference = candidates.reference if reads else candidates.reference[:0]
    outlook = outlook_of(model, points, reference, unanswered)
    distance = nearest(definition, points, earlier)
    picks: list[int] = []
    for column in outputs:
        output, allowed = outlook[column], distance >= NEAR
        if not bool(allowed.any()):
            break
        value = distance
        if output is not None:
            view = candidate_view(model, candidates, column, output, tolerances[column], distance)
            value = value_of(acquisition, view)
        if candidates.reserved is not None and not picks and bool((allowed & candidates.reserved).any()):
            allowed &= candidates.reserved
        elif output is not None:
            allowed &= output.learns
        pick = int(torch.where(allowed, value, -torch.inf).argmax())
        if allowed[pick]:
            picks.append(pick)
            outlook = tuple(None if output is None else output.observe(pick) for output in outlook)
            distance = torch.minimum(distance, nearest(definition, points, points[pick : pick + 1]))
    return picks


def candidate_view(
    model: DynamicsModel,
    candidates: Candidates,
    column: int,
    outlook: OutputOutlook,
    tolerance: float,
    distance: Tensor,
) -> CandidateView:
    """Build an acquisition's view of the candidates, for the output ``column``, which has varied.

    Args:
        model: the model.
        candidates: m points.
        column: number of the output.
        outlook: of the output at the candidates.
        tolerance: in the output's unit.
        distance: (m,) to the queries so far.
    """
    return CandidateView(
        model=model,
        points=candidates.points,
        output=column,
        tolerance=tolerance,
        deviation=outlook.deviation,
        distance=distance,
        log_probability=candidates.log_p,
        _reduction=lambda: outlook.reduction(candidates.weights),
    )


def nearest(definition: EnvironmentDefinition, points: Points, earlier: Points) -> Tensor:
    """Distance of m points to the nearest taken query, in standard deviations of the sampling range, (m,)."""
    if not len(earlier):
        return points.q.new_full((len(points),), torch.inf)
    return distances(definition, points, earlier).amin(1)
