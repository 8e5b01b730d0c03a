"""Forecast of how further real steps would reduce a model's variance, by the model itself or from distances."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import reduce

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.features import distances
from surrogym_server.environment.points import Points
from surrogym_server.models.abilities import Lookahead, OutputOutlook, PathOutlook, PredictedSteps, offers
from surrogym_server.models.port import DynamicsModel
from surrogym_server.sampling.confidence import stds


def outlook_of(
    model: DynamicsModel, candidates: Points, reference: Points, unanswered: Points
) -> tuple[OutputOutlook | None, ...]:
    """Return, for every output, a forecast of how real steps at m candidates would change the variance at the
    candidates and at r reference points; None for an output that never varied.

    The forecast is made as if the steps ``unanswered``, which are requested already, had been taken.
    """
    if (able := offers(model, Lookahead)) is not None:
        return able.outlook(candidates, reference, unanswered)
    return NearbyAnswers.of(model, candidates, reference, unanswered)


def path_outlook(model: DynamicsModel, steps: PredictedSteps, column: int) -> PathOutlook | None:
    """Return a forecast of the information that real steps along b predicted paths of T steps would give about the
    output with index ``column``; None if the output never varied."""
    if (able := offers(model, Lookahead)) is not None:
        return able.along(steps, column)
    spread = stds(model, steps.flat.q, steps.flat.u)[:, column].reshape(steps.q.shape[:-1])
    return IndependentSteps(spread, torch.ones_like(spread, dtype=torch.bool))


def as_if_answered(model: DynamicsModel, steps: PredictedSteps) -> DynamicsModel:
    """Return the model as if the T real steps ``steps`` had been taken with the predicted results. A model without the
    ability ``Lookahead`` is returned unchanged."""
    able = offers(model, Lookahead)
    return model if able is None else able.as_if_answered(steps)


@dataclass(frozen=True)
class NearbyAnswers(OutputOutlook):
    """Forecast of the effect of further real steps on an output's standard deviations, computed from distances alone.
    It is used for models that can't compute it themselves.

    The outputs at two points at distance d, in standard deviations of the sampling range, are assumed to have the
    correlation exp(-d^2 / 2). A real step removes all variance at its own point.
    """

    definition: EnvironmentDefinition
    candidates: Points  # m states and actions at which real steps may be taken
    reference: Points  # r states and actions at which the variance should become small
    own: Tensor  # (m,) variance at each candidate, as if all queries so far were answered
    there: Tensor  # (r,) variance at each reference point, as if all queries so far were answered
    # (m,) bool: whether a model would learn from a step at the candidate; it does not if a lag (past value) is unknown.
    learns: Tensor

    @classmethod
    def of(
        cls, model: DynamicsModel, candidates: Points, reference: Points, unanswered: Points
    ) -> tuple[NearbyAnswers, ...]:
        """Build the forecast for every output (O,), as if the queries ``unanswered`` had been answered."""
        own, there = (stds(model, points.q, points.u).square() for points in (candidates, reference))
        definition, learns = model.definition, torch.ones(len(candidates), dtype=torch.bool)
        outputs = (
            cls(definition, candidates, reference, own[:, column], there[:, column], learns)
            for column in range(own.shape[1])
        )
        queries = [unanswered[index : index + 1] for index in range(len(unanswered))]
        return tuple(reduce(cls.answered, queries, output) for output in outputs)

    @property
    def std(self) -> Tensor:
        return self.own.sqrt()

    def reduction(self, weights: Tensor) -> Tensor:
        return (weights * self.there) @ _removed_share(self.definition, self.reference, self.candidates)

    def observe(self, index: int) -> NearbyAnswers:
        return self.answered(self.candidates[index : index + 1])

    def answered(self, query: Points) -> NearbyAnswers:
        """Return the forecast as if the real step ``query`` had been taken too."""
        own, there = (
            _removed_share(self.definition, points, query)[:, 0] for points in (self.candidates, self.reference)
        )
        return replace(self, own=self.own * (1 - own), there=self.there * (1 - there))


@dataclass(frozen=True)
class IndependentSteps(PathOutlook):
    """Forecast of the information that steps along b paths give about an output, as if steps were independent: 1/2 sum
    log(1 + (w sigma / tau)^2), with weights w, standard deviations sigma and tolerance tau.

    It is used for models that can't compute the effect of further steps themselves.
    """

    spread: Tensor  # (b, T) standard deviation without noise at each step, in the output's unit
    # (b, T) bool: whether a model would learn from the step; it does not if a lag (past value) is unknown.
    learns: Tensor

    @property
    def std(self) -> Tensor:
        return self.spread

    def information(self, weight: Tensor, tolerance: float) -> Tensor:
        return 0.5 * (weight * self.spread / tolerance).square().log1p().cumsum(-1)


def _removed_share(definition: EnvironmentDefinition, points: Points, queries: Points) -> Tensor:
    """Return the share of the variance at each of m points that each of k real steps (queries) would remove, (m, k)."""
    return (-distances(definition, points, queries).square()).exp()
