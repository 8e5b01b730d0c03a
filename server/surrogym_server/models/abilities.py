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
    """Ability of a ``Learner`` to use a prior: an earlier model of the same family and definition, such as a model of a
    simulator of the environment.

    A learner without this ability: ``services`` refuses the prior.
    """

    @abstractmethod
    def learn_beside(
        self, prior: DynamicsModel, definition: EnvironmentDefinition, samples: Samples, warm: Warm | None = None
    ) -> Learned:
        """Fit as ``Learner.learn`` does, but use the prior's prediction as the prior mean of an output if left-out
        samples are then predicted better.

        Raises:
            TypeError: the prior belongs to another family.
            InvalidInput: too few samples to learn from.
            NumericalFailure: the fit fails on these samples.
        """


class FunctionDraws(ABC):
    """Ability to sample functions from the posterior. An episode can follow one of them: equal inputs then give equal
    predictions throughout the episode.

    For a model without this ability, ``models.draws`` draws one standard normal number for each transition output and
    episode, and adds this number of standard deviations to the output's mean at all states.
    """

    @property
    @abstractmethod
    def path_size(self) -> int:
        """Number W of weights that represent a sampled function; also the number of standard normal numbers from which
        they are computed."""

    @abstractmethod
    def draw(self, noise: Tensor) -> Tensor:
        """Return the weights (N, W) of N sampled functions, each computed from one row of standard normal numbers
        ``noise`` (N, W).

        The weights of a function depend on its own row alone, except for the last bits.
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
        """Predict as ``transition`` does, but with the values of a sampled function, one for each row, instead of the
        mean.

        Args:
            paths: (m, W') weights of the function of each row, W' >= W; the first W = ``path_size`` columns are used.
            q, u, process, stds, reward_std: as for ``transition``.
        """


class UncertainHyperparameters(ABC):
    """Ability to sample functions with sampled hyperparameters, because few samples don't determine the
    hyperparameters.

    For a model without this ability, ``virtual`` samples functions with the optimal hyperparameters, see
    ``FunctionDraws``.
    """

    @property
    @abstractmethod
    def uncertain_functions(self) -> FunctionDraws:
        """Sampler of functions that also samples the hyperparameters of each function.

        The first use of this property may take as long as a fit. If the sampler has compiled steps, it offers them by
        the ability ``CompiledSteps``, independently of the model.
        """


@dataclass(frozen=True)
class LeaveOneOutErrors:
    """Errors of one output when each sample in turn is predicted from all others."""

    error: float  # root mean square error, in the output's unit
    within_one: float  # share of the samples within one predictive standard deviation; ideally 0.68
    within_two: float  # share of the samples within two predictive standard deviations; ideally 0.95


class LeaveOneOut(ABC):
    """Ability to compute leave-one-out errors on the samples.

    For a model without this ability, the errors are unknown: None in the fidelity report. A design that requires
    leave-one-out errors within the tolerances then never counts as ready, and spends its whole budget.
    """

    @abstractmethod
    def leave_one_out(self) -> tuple[LeaveOneOutErrors, ...]:
        """Return the leave-one-out errors of each output, (O,). They are zero for an output that never varied."""


class LearnedNoise(ABC):
    """Ability to learn the noise of a single step together with the function.

    For a model without this ability, ``sampling`` treats the environment as noiseless and repeats no query.
    """

    @property
    @abstractmethod
    def noise_stds(self) -> tuple[float, ...]:
        """Standard deviation of each output's noise, in the output's unit, (O,)."""

    @property
    def possible_noise(self) -> tuple[float, ...]:
        """Greatest standard deviation of each output's noise that is plausible, (O,). If a fit with more noise makes
        the samples at least as likely as the learned model does, it is the noise of that fit, otherwise ``noise_stds``.
        """
        return self.noise_stds


@dataclass(frozen=True)
class AtSamples:
    """Values of one output at k of the samples, and the prior covariance of its function there, in the output's
    unit."""

    rows: Tensor  # (k,) indices of the samples
    targets: Tensor  # (k,) values of the output less their mean
    covariance: Tensor  # (k, k) prior covariance of the function at the samples, without noise
    noise_variance: float


class SampledFunctions(ABC):
    """Ability to give the prior covariance of an output's function at the samples. With it, ``sampling`` tests whether
    noise is independent from step to step or comes from a sensor or from hidden state.

    For a model without this ability, ``sampling`` does not distinguish sensor noise from process noise.
    """

    @abstractmethod
    def at_samples(self, samples: Samples, column: int) -> AtSamples | None:
        """Return values and prior covariance of the output with index ``column`` at the samples from which it is
        learned; None for an output that never varied."""


class OutputOutlook(ABC):
    """Forecast of one output's standard deviations at m candidates, in the output's unit, as if certain queries had
    been answered."""

    learns: Tensor  # (m,) bool: whether the output would learn from a sample at the candidate

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
        """Return the forecast as if the candidate ``index`` had been sampled too."""


class PathOutlook(ABC):
    """Forecast of one output along b predicted paths of T steps: its standard deviations at these steps, and the
    information that real steps along the paths would give about the output."""

    learns: Tensor  # (b, T) bool: whether the output would learn from a real step at that point of a path

    @property
    @abstractmethod
    def std(self) -> Tensor:
        """Standard deviation at each step, in the output's unit, (b, T)."""

    @abstractmethod
    def information(self, weight: Tensor, tolerance: float) -> Tensor:
        """Return the information about this output that each path would give up to each of its steps, in nats, (b, T).

        Each step counts with what it adds to the earlier steps of its path, so a state that is visited again adds
        little.

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
        """The same steps as one list: tensors (k, C) or (k, F), with k the number of all steps of all paths."""
        return PredictedSteps(*(tensor.flatten(0, -2) for tensor in (self.q, self.u, self.q_next)))


class Lookahead(ABC):
    """Ability to forecast how further real steps would change the model's standard deviations, before these steps are
    taken.

    For a model without this ability, ``sampling`` assumes that outputs are correlated at nearby points, depending on
    their distance in standard deviations of the sampling range. The steps of a path then count as independent, and
    planning a path does not change the model with which the next path is planned.
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
        """Return the model as if T real steps had been taken with the predicted results: standard deviations decrease,
        means stay."""


class RewardEdges(ABC):
    """Ability to find regions of states inside which the reward is higher or lower by a constant, so that it jumps at
    their edge.

    For a model without this ability, ``sampling`` knows no such edges and spends no query on them.
    """

    @abstractmethod
    def reward_edge_doubts(self, q: Tensor, q_next: Tensor) -> Iterator[Tensor]:
        """Yield, for each region of states at whose edge the reward jumps, the probability (m,) that the model is wrong
        about whether a step from q (m, C) to q_next (m, C) is inside the region."""


class RewardPeaks(ABC):
    """Ability to learn rewards that are nearly zero almost everywhere, so that the design can search for their peaks.

    For a model without this ability, ``sampling`` spends no query on such a search.
    """

    @property
    @abstractmethod
    def reward_hides(self) -> bool:
        """Whether this model's reward is nearly zero almost everywhere and was learned by a method that finds peaks,
        such as a fit to its logarithm."""

    @abstractmethod
    def promise(self, q: Tensor, u: Tensor) -> Tensor:
        """Return an optimistic score of the reward of steps from q (m, C) under u (m, F), (m,). It is higher where the
        reward may be larger, given the model's uncertainty.

        Only the order of the scores matters, which is that of the optimistic rewards. It is also meaningful among
        points whose rewards are nearly zero.
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
    """Function that computes a model's ``transition`` and ``terminated`` in one call on NumPy arrays. Two objects are
    equal only if they are the same object."""

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
            paths: (m, W) weights of a sampled function for each row, as for ``FunctionDraws.transition_along``; None
                for the mean.
        """


class CompiledSteps(ABC):
    """Ability to predict steps by compiled code on CPU arrays. Results agree with ``transition`` except for the last
    bits. For few rows, compiled code takes a tenth of the time.

    For a model without this ability, ``virtual`` calls ``transition`` and ``terminated``.
    """

    @abstractmethod
    def compiled(self) -> ArraySteps | None:
        """Return the model's compiled steps; None if this installation can't compile, or if the model is on another
        device than the CPU.

        The first call in a process loads compiled code. The first call on a machine compiles it.
        """

    @abstractmethod
    def compiled_pays(self, *, stds: bool) -> bool:
        """Return whether compiled steps are faster than ``transition``. ``stds`` says whether each step computes
        standard deviations."""


@dataclass(frozen=True)
class StepSource:
    """C99 source of functions that compute a model's mean step, its standard deviations and its termination. The file
    ``step.h`` declares them."""

    files: Mapping[str, str]  # file contents by name; step.c is the file to compile
    numbers: int  # number of float64 constants in the source


class WrittenInC(ABC):
    """Ability to write the mean step as C source, for programs that have no Python.

    A model without this ability can't be deployed: ``deployment`` refuses it and names the families that have the
    ability.
    """

    @abstractmethod
    def step_source(self) -> StepSource | None:
        """Return the C source of the mean step, which agrees with ``transition`` except for the last bits.

        None if numba is not installed, which the model's tables of numbers need, if the model adds to a prior model, or
        if it is on another device than the CPU.
        """
