"""Abilities that only some families of models have. Each is a class that a model inherits besides ``DynamicsModel``.

To use an ability, code calls ``offers`` and has a fallback for models without it. The ability's docstring states the
fallback.

Letters of shapes are those of ``models.port``. Further letters stand for r reference points, b paths of T steps, and N
sampled functions of W weights.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
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

    If a learner lacks this ability, the server refuses a prior for it (``features.priors``).
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
    """Ability to sample functions from the posterior. An episode can follow a sampled function: equal inputs then give
    equal predictions throughout the episode.

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

        Except for rounding errors, the weights of a function depend on its own row of ``noise`` alone.
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
        """Predict as ``transition`` does, but with values of sampled functions instead of the mean. Each of the m rows
        has its own function.

        Args:
            paths: (m, W') weights of the function of each row, W' >= W; the first W = ``path_size`` columns are used.
            q, u, process, stds, reward_std: as for ``DynamicsModel.transition``.
        """


class UncertainHyperparameters(ABC):
    """Ability to sample functions whose hyperparameters are sampled too, because few samples don't determine the
    hyperparameters.

    For a model without this ability, ``virtual`` samples functions with the optimal hyperparameters, see
    ``FunctionDraws``.
    """

    @property
    @abstractmethod
    def uncertain_functions(self) -> FunctionDraws:
        """Object that samples functions, each with sampled hyperparameters.

        The first use of this property may take as long as a fit. If the object can predict by compiled code, it has
        the ability ``CompiledSteps`` itself, whether or not the model has it.
        """


@dataclass(frozen=True)
class LeaveOneOutErrors:
    """Errors of one output when each sample in turn is predicted from all others."""

    error: float  # root mean square error, in the output's unit
    within_one: float  # share of errors up to one predictive standard deviation; 0.68 would be ideal
    within_two: float  # share of errors up to two predictive standard deviations; 0.95 would be ideal


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

    For a model without this ability, ``sampling`` treats the environment as noiseless and repeats no real step.
    """

    @property
    @abstractmethod
    def noise_stds(self) -> tuple[float, ...]:
        """Standard deviation of the noise that was learned for each output, in the output's unit, (O,)."""

    @property
    def possible_noise(self) -> tuple[float, ...]:
        """Greatest plausible standard deviation of each output's noise, (O,): the noise of another fit if the samples
        are at least as likely under it as under this model, otherwise that in ``noise_stds``."""
        return self.noise_stds


@dataclass(frozen=True)
class AtSamples:
    """Values of one output at those k samples from which it is learned, and the prior covariance of its function there,
    in the output's unit."""

    rows: Tensor  # (k,) indices, among all samples, of the k samples from which the output is learned
    targets: Tensor  # (k,) the output at each of these k samples, less the mean
    covariance: Tensor  # (k, k) prior covariance of the function at the samples, without noise
    noise_variance: float


class SampledFunctions(ABC):
    """Ability to give the prior covariance of an output's function at the samples. With it, ``sampling`` tests whether
    noise is independent from step to step or comes from a sensor or from hidden state.

    For a model without this ability, ``sampling`` treats all noise as independent from step to step.
    """

    @abstractmethod
    def at_samples(self, samples: Samples, column: int) -> AtSamples | None:
        """Return values and prior covariance of the transition output with index ``column`` at the samples from which
        it is learned; None for an output that never varied."""


class OutputOutlook(ABC):
    """Forecast of one output's standard deviations at m candidates for real steps, in the output's unit, as if certain
    other real steps had been taken."""

    learns: Tensor  # (m,) bool, true for each candidate at which a real step would teach the output something

    @property
    @abstractmethod
    def std(self) -> Tensor:
        """Standard deviations at the candidates, (m,)."""

    @abstractmethod
    def reduction(self, weights: Tensor) -> Tensor:
        """Return by how much a real step at each of m candidates would lower the sum of the variances at r reference
        points, weighted by ``weights`` (r,); result (m,)."""

    @abstractmethod
    def observe(self, index: int) -> OutputOutlook:
        """Return the forecast as if a real step had also been taken at the candidate with this index."""


class PathOutlook(ABC):
    """Forecast of one output along b predicted paths of T steps: its standard deviations at these steps, and the
    information that real steps along the paths would give about the output."""

    learns: Tensor  # (b, T) bool, true for each step of a path that would teach the output something

    @property
    @abstractmethod
    def std(self) -> Tensor:
        """Standard deviation at each step, in the output's unit, (b, T)."""

    @abstractmethod
    def information(self, weight: Tensor, tolerance: float) -> Tensor:
        """Return the information about this output that the first 1, 2, ... T real steps along each path would give
        together, in nats, (b, T). So a state that is visited again adds little.

        Args:
            weight: (b, T) weight of each step.
            tolerance: tolerance of the output, in its unit.
        """


@dataclass(frozen=True)
class PredictedSteps:
    """Predicted steps: any number of them, for example b paths of T steps with leading dimensions (b, T).

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
        """Return for each of the O outputs a forecast of its standard deviations at m candidates and r reference
        points, as if real steps at the points ``assumed`` had been taken.

        The entry of an output that never varied is None.
        """

    @abstractmethod
    def along(self, steps: PredictedSteps, column: int) -> PathOutlook | None:
        """Return the forecast of the output with index ``column`` along b paths of T steps; None for an output that
        never varied."""

    @abstractmethod
    def as_if_answered(self, steps: PredictedSteps) -> DynamicsModel:
        """Return the model as if the T real steps ``steps`` had been taken with the predicted results: standard
        deviations decrease, means stay."""


class RewardEdges(ABC):
    """Ability to find regions of states inside which the reward is higher or lower by a constant, so that it jumps at
    their edge.

    For a model without this ability, ``sampling`` requests no real steps to locate such edges.
    """

    @abstractmethod
    def reward_edge_doubts(self, q: Tensor, q_next: Tensor) -> Iterator[Tensor]:
        """Yield, for each region of states at whose edge the reward jumps, the probability (m,) that the model is wrong
        about whether a step from q (m, C) to q_next (m, C) is inside the region."""


class RewardPeaks(ABC):
    """Ability to learn rewards that are nearly zero almost everywhere, so that the design can search for their peaks.

    For a model without this ability, ``sampling`` requests no real steps for such a search.
    """

    @property
    @abstractmethod
    def reward_hides(self) -> bool:
        """Whether this model's reward is nearly zero almost everywhere and was learned by a method that finds peaks,
        such as a fit to its logarithm."""

    @abstractmethod
    def promise(self, q: Tensor, u: Tensor) -> Tensor:
        """Return an optimistic score (m,) of the reward of each step from q (m, C) under u (m, F). The score is higher
        where the reward may be larger, given the model's uncertainty.

        Only the order of the scores matters. It is also meaningful among points whose rewards are nearly zero.
        """


Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ArrayTransition:
    """Predicted step from each of m points, as NumPy arrays."""

    q_next: Floats  # (m, C) coordinates after the step
    reward: Floats  # (m,) mean reward, without the terminal reward and without a penalty for uncertainty
    std: Floats  # (m, O) standard deviations of the outputs, the reward last; only those requested are valid
    terminated: NDArray[np.bool_]  # (m,) whether the step ends the episode


class ArraySteps(ABC):
    """Callable object that computes a model's ``transition`` and ``terminated`` in one call on NumPy arrays. Two such
    objects are equal only if they are the same object."""

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


@dataclass(frozen=True)
class Avoided:
    """Limits that plans keep. A step beyond them costs ``price`` times 1 plus its distance beyond them, as
    ``environment.compiled.limits`` computes it from the tables ``numbers`` and ``places``."""

    numbers: Floats = field(default_factory=lambda: np.zeros(0))
    places: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 3), np.int64))  # of length 0: no limits
    price: float = 0.0


@dataclass(frozen=True)
class GridPolicy:
    """A policy and its values at the S nodes of a grid of states, as ``compiled.grid`` describes it. The grid is one of
    the first K coordinates; the others repeat past actions."""

    grid: tuple[Floats, Floats, NDArray[np.int64], NDArray[np.bool_]]  # low, cell, count, cyclic, (K,) each
    values: Floats  # (S,) expected return from each node
    table: Floats  # (S, F) action at each node
    discount: float  # factor of later rewards
    choices: int  # number of discrete actions; 0 for continuous actions
    least: Floats  # (F,) smallest action
    most: Floats  # (F,) largest action
    avoided: Avoided = field(default_factory=Avoided)


class PlannedActions(ABC):
    """Ability to plan an action by rollouts of the mean around a policy on a grid, in one call of compiled code.

    A model without this ability is refused by ``planning``.
    """

    @property
    @abstractmethod
    def plans(self) -> bool:
        """Whether the model can plan. It can't without compiled steps, or if its prior model has a prior itself."""

    @abstractmethod
    def for_planning(self) -> DynamicsModel:
        """Return a model with nearly the same means, which are faster to compute. Its standard deviations have no
        meaning."""

    @abstractmethod
    def planned(
        self,
        policy: GridPolicy,
        start: Floats,
        offset: Floats,
        early: NDArray[np.int64],
        late: bool,
        changes: Floats,
        elite: int,
        best: Floats,
    ) -> tuple[Floats, Floats]:
        """Return the first action (F,) of the best of R rounds of N rollouts over T steps, and the state (C,) that the
        model predicts after it.

        Args:
            policy: the policy, which acts in each rollout, and the values after the last step.
            start: (C,) state.
            offset: (C,) numbers to add to the predicted change of each coordinate at every step. A model of changes of
                the observation ignores them.
            early: (E, 2) index and action entry of the coordinates that take the value of each step's action before the
                step, because an action acts later than it is chosen.
            late: whether the policy and the values are functions of the end of a step without the new action.
            changes: (R, N, T, F) changes of the policy's actions to try: numbers to add to the mean plan of the round
                before; or discrete actions, -1 for the policy's, -2 for the best plan's.
            elite: number of the best rollouts of a round whose mean the next round changes.
            best: (T, F) plan of an earlier decision, which is tried too. It becomes the best plan.
        """


class CompiledSteps(ABC):
    """Ability to predict steps by compiled code on CPU arrays. Results equal those of ``transition`` except for
    rounding errors. For few rows, compiled code takes a tenth of the time.

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
        """Return the C source of the mean step, whose results equal those of ``transition`` except for rounding errors.

        The result is None if numba is not installed, which is needed to arrange the model's numbers, if the model adds
        to the predictions of a prior model, or if it is on another device than the CPU.
        """
