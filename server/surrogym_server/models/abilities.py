"""Abilities that only some families of models have. Each is a class that a model inherits besides ``DynamicsModel``.

Code that uses an ability calls ``offers``, and has a fallback for models without it. The ability's docstring states it.

Shapes as in ``models.port``; r reference points, b paths of T steps, N lanes, W numbers of a drawn function.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.points import Points
from surrogym_server.environment.samples import Samples
from surrogym_server.models.port import DynamicsModel, Learned, Transition, Warm

A = TypeVar("A")


def offers(model: DynamicsModel, ability: type[A]) -> A | None:
    """Return the model as an object with this ability; None if the model lacks the ability."""
    return model if isinstance(model, ability) else None


class TakesPrior(ABC):
    """Ability of a ``Learner`` to learn beside a prior: a model of the same family and definition, of what is known
    beforehand, such as one of a simulator.

    Fallback of ``services``: a prior is refused.
    """

    @abstractmethod
    def learn_beside(
        self, prior: DynamicsModel, definition: EnvironmentDefinition, samples: Samples, warm: Warm | None = None
    ) -> Learned:
        """Fit as ``Learner.learn`` does. Each output uses the prior only if it then predicts left-out samples better.

        Raises:
            TypeError: the prior is of another family.
            InvalidInput, NumericalFailure: as ``Learner.learn``.
        """


class FunctionDraws(ABC):
    """Ability to sample whole functions from the posterior, each consistent for a whole episode.

    Fallback of ``draws``: one standard normal number for each transition output is kept for the episode, and shifts
    this output everywhere by as many standard deviations. These are the draws of outputs whose errors are the same at
    all states.
    """

    @property
    @abstractmethod
    def path_size(self) -> int:
        """Number of standard normal numbers that a draw takes, which is also the size of the draw, W."""

    @abstractmethod
    def draw(self, noise: Tensor) -> Tensor:
        """Sample functions (N, W), one from each row of standard normal ``noise`` (N, W).

        Each draw is a pure function of its row, except for the last bits.
        """

    @abstractmethod
    def transition_along(
        self,
        paths: Tensor,
        q: Tensor,
        u: Tensor,
        *,
        process: Tensor | None = None,
        stds: bool = False,
        reward_std: bool = False,
    ) -> Transition:
        """Predict as ``transition`` does, with each row along a sampled function of its own.

        ``paths`` (m, W) are the functions; the first ``path_size`` columns are used.
        """


class UncertainHyperparameters(ABC):
    """Ability to sample functions with uncertain hyperparameters, because few samples don't determine them.

    Fallback of ``virtual``: the functions of ``FunctionDraws``, which are drawn with the optimal hyperparameters.
    """

    @property
    @abstractmethod
    def uncertain_functions(self) -> FunctionDraws:
        """Return the object that samples functions with uncertain hyperparameters.

        The model's first call may take as long as a fit. If the object has compiled steps, they are those of its own
        ``CompiledSteps``.
        """


@dataclass(frozen=True)
class LeaveOneOutErrors:
    """Errors of one output when each sample in turn is predicted from all others."""

    error: float  # root mean square, in the output's unit
    within_one: float  # share of the samples within one predictive standard deviation; 0.68 if that is right
    within_two: float  # the same within two: 0.95


class LeaveOneOut(ABC):
    """Ability to compute leave-one-out errors on the samples.

    Fallback of ``sampling``: the errors are unknown, None in the fidelity. A design that requires tests on left-out
    samples then never counts as ready, and spends its budget.
    """

    @abstractmethod
    def leave_one_out(self) -> tuple[LeaveOneOutErrors, ...]:
        """Return the leave-one-out errors of each output, (O,). They are zero for an output that never varied."""


class LearnedNoise(ABC):
    """Ability to learn the noise of a single step together with the function.

    Fallback of ``sampling``: the environment counts as noiseless, and no step is repeated.
    """

    @property
    @abstractmethod
    def noise_stds(self) -> tuple[float, ...]:
        """Standard deviation of each output's noise, in the output's unit, (O,)."""

    @property
    def possible_noise(self) -> tuple[float, ...]:
        """Standard deviation of each output's noise in another explanation of the samples, if it is at least
        as likely, (O,). Those that it has learned if the family looks for no other."""
        return self.noise_stds


@dataclass(frozen=True)
class AtSamples:
    """One output's process at k of the samples, in the output's unit."""

    rows: Tensor  # (k,) of the samples
    targets: Tensor  # (k,) less their mean
    covariance: Tensor  # (k, k) of the function before it has seen them, without noise
    noise_variance: float


class SampledFunctions(ABC):
    """Ability to give the covariance of an output's function at the samples, so that other explanations of the noise
    can be compared with independent noise.

    Fallback of ``sampling``: noise of the sensors is not told from noise of the process.
    """

    @abstractmethod
    def at_samples(self, samples: Samples, column: int) -> AtSamples | None:
        """Return the output ``column`` at the samples that it learns from; None for an output that never varied."""


class OutputOutlook(ABC):
    """Forecast of one output's standard deviations at m candidates after some further queries, in the output's unit."""

    learns: Tensor  # (m,) bool: whether a sample at the candidate would improve this output

    @property
    @abstractmethod
    def std(self) -> Tensor:
        """Return the standard deviations at the candidates, (m,)."""

    @abstractmethod
    def reduction(self, weights: Tensor) -> Tensor:
        """Return by how much a sample at each of m candidates lowers the weighted sum of the variances at r reference
        points.

        Shapes: weights (r,), result (m,)."""

    @abstractmethod
    def observe(self, index: int) -> OutputOutlook:
        """Assume that the candidate ``index`` has been sampled as well."""


class PathOutlook(ABC):
    """Forecast of one output along b predicted paths of T steps."""

    learns: Tensor  # (b, T) bool: whether a real step there would improve this output

    @property
    @abstractmethod
    def std(self) -> Tensor:
        """Return the standard deviation at each step, in the output's unit, (b, T)."""

    @abstractmethod
    def information(self, weight: Tensor, tolerance: float) -> Tensor:
        """Return the information of the steps up to each one, in nats, (b, T).

        The steps have weights (b, T), and the tolerance is in the output's unit. A step is evaluated given those before
        it, so a repeated state adds little.
        """


@dataclass(frozen=True)
class PredictedSteps:
    """Steps of predicted paths: coordinates (..., C), actions (..., F), and coordinates after the step (..., C)."""

    q: Tensor
    u: Tensor
    q_next: Tensor

    @property
    def flat(self) -> PredictedSteps:
        """Return the same steps with a single leading dimension."""
        return PredictedSteps(*(tensor.flatten(0, -2) for tensor in (self.q, self.u, self.q_next)))


class Lookahead(ABC):
    """Ability to forecast how further real steps would change the standard deviations, before they are taken.

    Fallback of ``sampling``: a sample is assumed to be correlated with nearby points, by their distance in standard
    deviations of the sampling range. Along paths the steps count as independent, and a planned path does not change the
    model for the next path.
    """

    @abstractmethod
    def outlook(self, candidates: Points, reference: Points, assumed: Points) -> tuple[OutputOutlook | None, ...]:
        """Forecast every output (O,) at m candidates and r reference points, once the queries ``assumed`` are answered.

        The entry of an output that never varied is None.
        """

    @abstractmethod
    def along(self, steps: PredictedSteps, column: int) -> PathOutlook | None:
        """Forecast the output ``column`` along steps (b, T, ...); None for an output that never varied."""

    @abstractmethod
    def as_if_answered(self, steps: PredictedSteps) -> DynamicsModel:
        """Return the model as if real steps (T, ...) had been taken as predicted: standard deviations shrink, means
        stay."""


class RewardEdges(ABC):
    """Ability to find sets of states at whose edges the reward jumps.

    Fallback of ``sampling``: no edges are known, and no query is spent on them.
    """

    @abstractmethod
    def reward_edge_doubts(self, q: Tensor, q_next: Tensor) -> Iterator[Tensor]:
        """Return for each edge the probability (m,) that the model has steps from q (m, C) to q_next (m, C) on the
        wrong side."""


class RewardPeaks(ABC):
    """Ability to learn rewards that are nearly zero almost everywhere, so that the design can search for their peaks.

    Fallback of ``sampling``: no query is spent on the search.
    """

    @property
    @abstractmethod
    def reward_hides(self) -> bool:
        """Whether this model's reward is nearly zero almost everywhere, and was learned in the way that finds its
        peaks."""

    @abstractmethod
    def promise(self, q: Tensor, u: Tensor) -> Tensor:
        """Return how high the reward of steps from q (m, C) under u (m, F) may be, given the uncertainty, (m,).

        The unit is free. The values keep the order of rewards, and distinguish points whose rewards are nearly zero.
        """


Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ArrayTransition:
    """Predicted step from m points, as arrays."""

    q_next: Floats  # (m, C)
    reward: Floats  # (m,) as in ``Transition``
    std: Floats  # (m, O) of the requested outputs, the reward's last
    terminated: NDArray[np.bool_]  # (m,)


class ArraySteps(ABC):
    """``transition`` and ``terminated`` of one model in one call. Compared and hashed by identity."""

    definition: EnvironmentDefinition

    @abstractmethod
    def __call__(
        self,
        q: Floats,
        u: Floats,
        *,
        noise: Floats | None,
        process: Floats | None,
        paths: Floats | None,
        stds: bool,
        reward_std: bool,
    ) -> ArrayTransition:
        """Predict the step from q (m, C) under u (m, F).

        The arguments are those of ``transition``, and ``paths`` (m, W) as in ``transition_along`` for a family that
        draws functions.
        """


class CompiledSteps(ABC):
    """Ability to step by compiled code on CPU arrays. Results are the same except for the last bits. A few rows take a
    tenth of the time.

    Fallback of ``virtual``: ``transition`` and ``terminated``.
    """

    @abstractmethod
    def compiled(self) -> ArraySteps | None:
        """Return the model's compiled steps; None if this installation can't compile, or if the model is on another
        device.

        The first call in a process loads compiled code. The first call on a machine compiles it.
        """

    @abstractmethod
    def compiled_pays(self, *, stds: bool) -> bool:
        """Whether compiled steps are faster, with standard deviations in every step or without."""


@dataclass(frozen=True)
class StepSource:
    """C99 source of ``transition``, its standard deviations and ``terminated``: the functions that its ``step.h``
    declares."""

    files: Mapping[str, str]  # content by name; step.c is what a compiler takes
    numbers: int  # float64 constants in it


class WrittenInC(ABC):
    """Ability to write the mean step as C source, for programs that have no Python.

    Fallback of ``deployment``: the model is refused, with the families that have this ability.
    """

    @abstractmethod
    def step_source(self) -> StepSource | None:
        """Return the source; None if this installation lacks numba, which lays out the tables, or if the model is on
        another device. Its steps are those of ``transition``, except for the last bits."""
