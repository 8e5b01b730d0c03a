"""Greedy batches of queries from a candidate set, by an acquisition (eq. 13)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.features import distances
from surrogym_server.environment.points import Points
from surrogym_server.models.abilities import PredictedSteps
from surrogym_server.models.port import DynamicsModel
from surrogym_server.sampling.acquisition import CandidateView, Outlooks, acquisition_of, value_of
from surrogym_server.sampling.candidates import Candidates
from surrogym_server.sampling.outlook import AfterSteps, outlook_of

NEAR = 0.02  # queries closer than this, in deviations of the sampling range, are near-duplicates


def choose(
    model: DynamicsModel,
    candidates: Candidates,
    taken: Points,
    assumed: Points,
    wanted: Sequence[int],
    tolerances: Sequence[float],
    reserved: Tensor | None = None,
    optimal: Sequence[PredictedSteps] = (),
) -> list[int]:
    """Choose a greedy batch: for each output in ``wanted`` the best candidate, given answers to those chosen before it.

    Args:
        model: the model whose deviations the batch should lower.
        candidates: points to choose from.
        taken: all queries so far, answered or not; no query close to one of them is chosen.
        assumed: unanswered queries, which are treated as answered.
        wanted: for each query, the number of the output that it is chosen for.
        tolerances: (O,) in each output's unit.
        reserved: (m,) bool, the candidates from which the first query is chosen.
        optimal: optimal trajectories, each (T, ...), that the acquisition reads.

    Returns:
        Indices of candidates; fewer than wanted if no distinct candidate is left.
    """
    definition, points = model.definition, candidates.points
    acquisition = definition.design.acquisition
    # The covariances of the reference cost the most.
    reads = acquisition_of(acquisition).reads_reference
    reference = candidates.reference if reads else candidates.reference[:0]
    outlook = outlook_of(model, points, reference, assumed)
    given = tuple(AfterSteps.of(model, steps).outlook(points, assumed) for steps in optimal)
    distance = nearest(definition, points, taken)
    picks: list[int] = []
    for column in wanted:
        output, allowed = outlook[column], distance >= NEAR
        if not bool(allowed.any()):
            break
        value = distance
        if output is not None:
            view = candidate_view(model, candidates, column, outlook, tolerances, distance, given)
            value = value_of(acquisition, view)
        if reserved is not None and not picks and bool((allowed & reserved).any()):
            allowed &= reserved
        elif output is not None:
            allowed &= output.learns
        pick = int(torch.where(allowed, value, -torch.inf).argmax())
        if allowed[pick]:
            picks.append(pick)
            outlook = _observed(outlook, pick)
            given = tuple(_observed(one, pick) for one in given)
            distance = torch.minimum(distance, nearest(definition, points, points[pick : pick + 1]))
    return picks


def candidate_view(
    model: DynamicsModel,
    candidates: Candidates,
    column: int,
    outlook: Outlooks,
    tolerances: Sequence[float],
    distance: Tensor,
    given: tuple[Outlooks, ...] = (),
) -> CandidateView:
    """Build an acquisition's view of the candidates, for the output ``column``, which has varied.

    Args:
        model: the model.
        candidates: m points.
        column: number of the output.
        outlook: of every output (O,) at the candidates.
        tolerances: (O,) in each output's unit.
        distance: (m,) to the queries so far.
        given: outlooks as if one optimal trajectory had been answered too, one for each.
    """
    output = outlook[column]
    assert output is not None
    return CandidateView(
        model=model,
        points=candidates.points,
        output=column,
        tolerance=tolerances[column],
        deviation=output.deviation,
        distance=distance,
        log_probability=candidates.log_p,
        _reduction=lambda: output.reduction(candidates.weights),
        tolerances=tuple(tolerances),
        _outlook=outlook,
        _given_optimal=given,
    )


def _observed(outlook: Outlooks, pick: int) -> Outlooks:
    """Outlook of every output after the candidate ``pick`` was answered."""
    return tuple(None if output is None else output.observe(pick) for output in outlook)


def nearest(definition: EnvironmentDefinition, points: Points, taken: Points) -> Tensor:
    """Distance of m points to the nearest taken query, in deviations of the sampling range, (m,)."""
    if not len(taken):
        return points.q.new_full((len(points),), torch.inf)
    return distances(definition, points, taken).amin(1)
