"""Choose several real steps to request (queries) from a set of candidates, one after the other, by an acquisition
(eq. 13)."""

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
from surrogym_server.sampling.lookahead import outlook_of

# A candidate closer than this to an earlier query, in standard deviations of the sampling range, is not chosen.
NEAR = 0.02


def choose(
    model: DynamicsModel,
    candidates: Candidates,
    earlier: Points,
    unanswered: Points,
    outputs: Sequence[int],
    tolerances: Sequence[float],
) -> list[int]:
    """Choose real steps to request (queries) one after the other: for each entry of ``outputs`` the candidate with the
    largest value of the acquisition, as if the queries chosen before were answered.

    This needs no results of queries: given its hyperparameters, the variance of a Gaussian process depends only on the
    states and actions of its samples.

    Args:
        model: the model whose standard deviations the batch should lower.
        candidates: points to choose from. If some are reserved, the first query is one of them.
        earlier: all queries so far, answered or not; no query close to one of them is chosen.
        unanswered: queries without an answer yet; standard deviations are computed as if they were answered.
        outputs: for each query to choose, the index of the output that it should improve.
        tolerances: (O,) tolerance of each output, in its unit.

    Returns:
        Indices of the chosen candidates. There are fewer of them than entries of ``outputs`` if all other candidates
        are close to a query or would teach nothing.
    """
    definition, points = model.definition, candidates.points
    acquisition = definition.design.acquisition
    # Use the reference points only if the acquisition needs them, because their covariances take most of the time.
    reads = acquisition_of(acquisition).reads_reference
    reference = candidates.reference if reads else candidates.reference[:0]
    outlook = outlook_of(model, points, reference, unanswered)
    distance = nearest(definition, points, earlier)
    picks: list[int] = []
    for column in outputs:
        output, eligible = outlook[column], distance >= NEAR
        if not bool(eligible.any()):
            break
        value = distance
        if output is not None:
            view = candidate_view(model, candidates, column, output, tolerances[column], distance)
            value = value_of(acquisition, view)
        if candidates.reserved is not None and not picks and bool((eligible & candidates.reserved).any()):
            eligible &= candidates.reserved
        elif output is not None:
            eligible &= output.learns
        pick = int(torch.where(eligible, value, -torch.inf).argmax())
        if eligible[pick]:
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
    """Return the properties of the candidates, such as standard deviations, from which an acquisition rates them with
    respect to one output.

    Args:
        model: the model from which the outlook was computed.
        candidates: the m candidates.
        column: index of the output, which must vary in the samples.
        outlook: forecast of how further real steps would change the variance of this output.
        tolerance: tolerance of this output, in its unit.
        distance: (m,) distance of each candidate to the nearest query so far.
    """
    return CandidateView(
        model=model,
        points=candidates.points,
        output=column,
        tolerance=tolerance,
        std=outlook.std,
        distance=distance,
        log_probability=candidates.log_p,
        _reduction=lambda: outlook.reduction(candidates.weights),
    )


def nearest(definition: EnvironmentDefinition, points: Points, earlier: Points) -> Tensor:
    """Return the distance (m,) of each point to the nearest earlier query, in standard deviations of the sampling
    range; infinite if there is none."""
    if not len(earlier):
        return points.q.new_full((len(points),), torch.inf)
    return distances(definition, points, earlier).amin(1)
