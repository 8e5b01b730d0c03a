"""Abilities that only some families of models have. Each is a class that a model inherits besides ``DynamicsModel``.

To use an ability, code calls ``offers`` and has a fallback for models without it. The ability's docstring states the
fallback.

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
    """Ability of a ``Learner`` to use a prior: a model of the same family and definition that represents earlier
    knowledge, such as a model of a simulator.

    Fallback of ``services``: the prior is refused.
    """

    @abstractmethod
    def learn_beside(
        self, prior: DynamicsModel, definition: EnvironmentDefinition, samples: Samples, warm: Warm | None = None
    ) -> Learned:
        """Fit as ``Learner.learn`` does, with the prior's prediction as the mean of those outputs for which this
        predicts left-out samples better.

        Raises:
            TypeError: the prior belongs to another family.
            InvalidInput: too few samples to learn from.
            NumericalFailure: the fit fails on these samples.
        """


class FunctionDraws(ABC):
    """Ability to sample whole functions from the posterior, each consistent for a whole episode.

    Fallback of ``models.draws``: keep one standard normal number for each transition output during an episode, and
    shift the output everywhere by that many standard deviations, as if its error were the same at all states.
    """

    @property
    @abstractmethod
    def path_size(self) -> int:
        """Number W of standard normal numbers that a sampled function takes, which is also its number of weights."""

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

        Args:
            paths: (m, W') the functions, W' >= W; the first W = ``path_size`` columns are used.
            q, u, process, stds, reward_std: as for ``transition``.
        """


class UncertainHyperparameters(ABC):
    """Ability to sample functions with sampled hyperparameters, because few samples don't determine these.

    Fallback of ``virtual``: the functions of ``FunctionDraws``, sampled with the optimal hyperparameters.
    """

    @property
    @abstractmethod
    def uncertain_functions(self) -> FunctionDraws:
        """Object that samples functions with uncertain hyperparameters.

        The first use of this property may take as long as a fit. If the object has compiled steps, they are those of
        its own ``CompiledSteps``.
        """


@dataclass(frozen=True)
class LeaveOneOutErrors:
    """Errors of one output when each sample in turn is predicted from all others."""

    error: float  # root mean square error, in the output's unit
    within_one: float  # share of the samples within one predictive standard deviation; ideally 0.68
    within_two: float  # share of the samples within two predictive standard deviations; ideally 0.95


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

    Fallback of ``sampling``: the environment counts as noiseless, and no query is repeated.
    """

    @property
    @abstractmethod
    def noise_stds(self) -> tuple[float, ...]:
        """Standard deviation of each output's noise, in the output's unit, (O,)."""

    @property
    def possible_noise(self) -> tuple[float, ...]:
        """Standard deviation of each output's noise in a noisier explanation of the samples, if one is at least as
        likely as the learned one, (O,). Equal to ``noise_stds`` if the family finds or looks for none."""
        return self.noise_stds


@dataclass(frozen=True)
class AtSamples:
    """Prior of one output's process at k of the samples, in the output's unit."""

    rows: Tensor  # (k,) indices of the samples
    targets: Tensor  # (k,) values of the output less their mean
    covariance: Tensor  # (k, k) prior covariance of the function at the samples, without noise
    noise_variance: float


class SampledFunctions(ABC):
    """Ability to give the covariance of an output's function at the samples, so that other explanations of the noise
    can be compared with independent noise.

    Fallback of ``sampling``: sensor noise is not distinguished from process noise.
    """

    @abstractmethod
    def at_samples(self, samples: Samples, column: int) -> AtSamples | None:
        """Return the process of the output ``column`` at the samples from which it learns; None for an output that
        never varied."""


class OutputOutlook(ABC):
    """Forecast of one output's standard deviations at m candidates after some assumed queries, in the output's unit."""

    learns: Tensor  # (m,) bool: whether a sample at the candidate would improve this output

    @property
    @abstractmethod
    def std(self) -> Tensor:
        """Standard deviations at the candidates, (m,)."""

    @abstractmethod
    def reduction(self, weights: Tensor) -> Tensor:
        """Return by how much a sample at each of m candidates lowers the weighted sum of the variances at r reference
        points.

        Shapes: weights (r,), result (m,)."""

    @abstractmethod
    def observe(self, index: int) -> OutputOutlook:
        """Return the forecast as if the candidate ``index`` had been sampled as well."""


class PathOutlook(ABC):
    """Forecast of one output along b predicted paths of T steps: its standard deviations, and the information that
    real steps there would give."""

    learns: Tensor  # (b, T) bool: whether a real step at that point of a path would improve this output

    @property
    @abstractmethod
    def std(self) -> Tensor:
        """Standard deviation at each step, in the output's unit, (b, T)."""

    @abstractmethod
    def information(self, weight: Tensor, tolerance: float) -> Tensor:
        """Return the information that the first steps of each path give about this output, in nats, (b, T).

        Entry t counts all steps up to t. A step is evaluated given the earlier ones, so a repeated state adds little.

        Args:
            weight: (b, T) weight of each step.
            tolerance: tolerance of the output, in its unit.
        """


@dataclass(frozen=True)
class PredictedSteps:
    """Steps of predicted paths, such as b paths of T steps.

    Attributes:
        q: coordinates before each step, (..., C).
        u: actions, (..., F).
        q_next: coordinates after each step, (..., C).
    """

    q: Tensor
    u: Tensor
    q_next: Tensor

    @property
    def flat(self) -> PredictedSteps:
        """The same steps with a single leading dimension."""
        return PredictedSteps(*(tensor.flatten(0, -2) for tensor in (self.q, self.u, self.q_next)))


class Lookahead(ABC):
    """Ability to forecast how further real steps would change the standard deviations, before they are taken.

    Fallback of ``sampling``: a sample is assumed to be correlated with nearby points, by their distance in standard
    deviations of the sampling range. Along paths the steps count as independent, and a planned path does not change the
    model for the next path.
    """

    @abstractmethod
    def outlook(self, candidates: Points, reference: Points, assumed: Points) -> tuple[OutputOutlook | None, ...]:
        """Forecast every output (O,) at m candidates and r reference points, as if the queries ``assumed`` had been
        answered.

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
        """Yield, for each edge, the probability (m,) that the model puts steps from q (m, C) to q_next (m, C) on the
        wrong side of the edge."""


class RewardPeaks(ABC):
    """Ability to learn rewards that are nearly zero almost everywhere, so that the design can search for their peaks.

    Fallback of ``sampling``: no query is spent on the search.
    """

    @property
    @abstractmethod
    def reward_hides(self) -> bool:
        """Whether this model's reward is nearly zero almost everywhere and was learned in the way that finds its
        peaks."""

    @abstractmethod
    def promise(self, q: Tensor, u: Tensor) -> Tensor:
        """Return an optimistic score of the reward of steps from q (m, C) under u (m, F), (m,): the higher, the larger
        the reward may be given the uncertainty.

        The scores have no unit. They keep the order of rewards, and distinguish points whose rewards are nearly zero.
        """


Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ArrayTransition:
    """Predicted step from each of m points, as NumPy arrays."""

    q_next: Floats  # (m, C) coordinates after the step
    reward: Floats  # (m,) mean, without the penalty and without the terminal reward
    std: Floats  # (m, O) requested standard deviations, the reward's last
    terminated: NDArray[np.bool_]  # (m,) whether the step ends the episode


class ArraySteps(ABC):
    """A model's ``transition`` and ``terminated`` in one call on NumPy arrays. Compared and hashed by identity."""

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

        Args:
            q, u, noise, process, stds, reward_std: as for ``DynamicsModel.transition``.
            paths: (m, W) sampled functions, as for ``FunctionDraws.transition_along``; None for the mean.
        """


class CompiledSteps(ABC):
    """Ability to step by compiled code on CPU arrays. Results agree with ``transition`` except for the last bits. A few
    rows take a tenth of the time.

    Fallback of ``virtual``: call ``transition`` and ``terminated``.
    """

    @abstractmethod
    def compiled(self) -> ArraySteps | None:
        """Return the model's compiled steps; None if this installation can't compile, or if the model is on another
        device.

        The first call in a process loads compiled code. The first call on a machine compiles it.
        """

    @abstractmethod
    def compiled_pays(self, *, stds: bool) -> bool:
        """Return whether compiled steps are faster than ``transition``; ``stds``: with standard deviations in each
        step."""


@dataclass(frozen=True)
class StepSource:
    """C99 source of a model's mean step, its standard deviations and its termination. The functions are declared in
    its ``step.h``."""

    files: Mapping[str, str]  # file contents by name; step.c is the file to compile
    numbers: int  # number of float64 constants in the source


class WrittenInC(ABC):
    """Ability to write the mean step as C source, for programs that have no Python.

    Fallback of ``deployment``: the model is refused, and the message names the families that have this ability.
    """

    @abstractmethod
    def step_source(self) -> StepSource | None:
        """Return the C source of the mean step, which agrees with ``transition`` except for the last bits.

        None if this installation lacks numba, which lays out the tables, or if the model is on another device.
        """
