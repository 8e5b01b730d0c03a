"""Abilities of a model of several families: those that all its parts have, by output.

An output's answer is that of the part which serves it. An ability of the reward alone is that of the reward's part. Two
abilities need not be those of all parts: functions are drawn of every model (``models.draws``), and a part that learns
no noise has none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any, Protocol

import torch
from torch import Tensor

from surrogym_server.environment.points import Points
from surrogym_server.environment.samples import Samples
from surrogym_server.models.abilities import (
    AtSamples,
    Differentiable,
    FunctionDraws,
    LearnedNoise,
    LeaveOneOut,
    LeaveOneOutErrors,
    Lookahead,
    OutputOutlook,
    PathOutlook,
    PredictedSteps,
    RewardEdges,
    RewardOfStep,
    RewardPeaks,
    SampledFunctions,
    UncertainHyperparameters,
)
from surrogym_server.models.port import DynamicsModel, Transition


class Whole(Protocol):
    """What abilities need of the model: its parts, the part of each output (O,), and how predictions are joined."""

    @property
    def parts(self) -> tuple[DynamicsModel, ...]: ...

    @property
    def serving(self) -> tuple[int, ...]: ...

    @property
    def functions(self) -> tuple[FunctionDraws, ...]: ...

    def joined(
        self,
        made: Sequence[Transition],
        q: Tensor,
        u: Tensor,
        *,
        reward_deviation: bool,
        draws: FunctionDraws | None = None,
        paths: Tensor | None = None,
    ) -> Transition: ...

    def with_parts(self, parts: Sequence[DynamicsModel]) -> DynamicsModel: ...


@dataclass(frozen=True)
class DrawsOfParts(FunctionDraws):
    """A function of every part. The random numbers of a draw are those of the parts, one after the other."""

    whole: Whole
    functions: tuple[FunctionDraws, ...]

    @property
    def path_size(self) -> int:
        return sum(one.path_size for one in self.functions)

    def draw(self, noise: Tensor) -> Tensor:
        return torch.cat([one.draw(own) for one, own in zip(self.functions, self.split(noise), strict=True)], 1)

    def transition_along(
        self,
        paths: Tensor,
        q: Tensor,
        u: Tensor,
        *,
        process: Tensor | None = None,
        deviations: bool = False,
        reward_deviation: bool = False,
    ) -> Transition:
        split = self.split(paths)
        made = [
            one.transition_along(own, q, u, process=process, deviations=deviations, reward_deviation=reward_deviation)
            for one, own in zip(self.functions, split, strict=True)
        ]
        paying = self.whole.serving[-1]
        return self.whole.joined(
            made, q, u, reward_deviation=reward_deviation, draws=self.functions[paying], paths=split[paying]
        )

    def split(self, paths: Tensor) -> tuple[Tensor, ...]:
        """The columns of each part, of columns (m, W) of all."""
        ends = list(accumulate(one.path_size for one in self.functions))
        return paths[:, : ends[-1]].tensor_split(ends[:-1], 1)


@dataclass(frozen=True)
class OfParts:
    """An ability by the parts' abilities, ``able``; None where a part lacks it."""

    whole: Whole
    able: tuple[Any, ...]

    def of(self, column: int) -> Any:
        """The ability of an output's part."""
        return self.able[self.whole.serving[column]]

    @property
    def columns(self) -> range:
        return range(len(self.whole.serving))


class UncertainFunctions(OfParts, UncertainHyperparameters):
    @property
    def uncertain_functions(self) -> FunctionDraws:
        pairs = zip(self.able, self.whole.functions, strict=True)
        return DrawsOfParts(self.whole, tuple(plain if a is None else a.uncertain_functions for a, plain in pairs))


class ErrorsOfParts(OfParts, LeaveOneOut):
    def leave_one_out(self) -> tuple[LeaveOneOutErrors, ...]:
        errors = [one.leave_one_out() for one in self.able]
        return tuple(errors[part][column] for column, part in enumerate(self.whole.serving))


class NoiseOfParts(OfParts, LearnedNoise):
    @property
    def noise_deviations(self) -> tuple[float, ...]:
        return tuple(0.0 if self.of(c) is None else self.of(c).noise_deviations[c] for c in self.columns)

    @property
    def possible_noise(self) -> tuple[float, ...]:
        return tuple(0.0 if self.of(c) is None else self.of(c).possible_noise[c] for c in self.columns)


class FunctionsAtSamples(OfParts, SampledFunctions):
    def at_samples(self, samples: Samples, column: int) -> AtSamples | None:
        found: AtSamples | None = self.of(column).at_samples(samples, column)
        return found


class LookaheadOfParts(OfParts, Lookahead):
    def outlook(self, candidates: Points, reference: Points, assumed: Points) -> tuple[OutputOutlook | None, ...]:
        outlooks = [one.outlook(candidates, reference, assumed) for one in self.able]
        return tuple(outlooks[part][column] for column, part in enumerate(self.whole.serving))

    def along(self, steps: PredictedSteps, column: int) -> PathOutlook | None:
        found: PathOutlook | None = self.of(column).along(steps, column)
        return found

    def as_if_answered(self, steps: PredictedSteps) -> DynamicsModel:
        return self.whole.with_parts([one.as_if_answered(steps) for one in self.able])


class RewardOfParts(OfParts, RewardOfStep):
    def reward_of_step(
        self, q: Tensor, u: Tensor, q_next: Tensor, *, paths: Tensor | None = None, deviation: bool = False
    ) -> tuple[Tensor, Tensor | None]:
        paying = self.whole.serving[-1]
        own = None if paths is None else DrawsOfParts(self.whole, self.whole.functions).split(paths)[paying]
        made: tuple[Tensor, Tensor | None] = self.able[paying].reward_of_step(
            q, u, q_next, paths=own, deviation=deviation
        )
        return made


class DifferentiableParts(OfParts, Differentiable):
    pass


OF_THE_REWARD: tuple[type, ...] = (RewardEdges, RewardPeaks)
OF_ALL: Mapping[type, type[OfParts]] = {
    LeaveOneOut: ErrorsOfParts,
    SampledFunctions: FunctionsAtSamples,
    Lookahead: LookaheadOfParts,
    RewardOfStep: RewardOfParts,
    Differentiable: DifferentiableParts,
}
OF_ANY: Mapping[type, type[OfParts]] = {UncertainHyperparameters: UncertainFunctions, LearnedNoise: NoiseOfParts}


def ability_of(whole: Whole, kind: type) -> object | None:
    """An object with an ability of several parts; None if they lack it."""
    if kind is FunctionDraws:
        return DrawsOfParts(whole, whole.functions)
    if kind in OF_THE_REWARD:
        return whole.parts[whole.serving[-1]].ability(kind)
    able = tuple(part.ability(kind) for part in whole.parts)
    if kind in OF_ALL and None not in able:
        return OF_ALL[kind](whole, able)
    if kind in OF_ANY and any(one is not None for one in able):
        return OF_ANY[kind](whole, able)
    return None
