"""What only some families of models can do: each a class of its own that a model inherits beside ``DynamicsModel``.

Who wants one asks ``offers``, and has a fallback, stated in the docstring of the ability.

Shapes as in ``models.port``; r reference points, b paths of T steps, N lanes, W numbers of a drawn function.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.points import Points
from surrogym_server.models.port import DynamicsModel, Transition

A = TypeVar("A")


def offers(model: DynamicsModel, ability: type[A]) -> A | None:
    """The model as something that has this ability; None where its family has not."""
    return model if isinstance(model, ability) else None


class FunctionDraws(ABC):
    """Whole functions drawn from what the model believes, each consistent for a whole episode.

    Fallback of ``virtual``: one standard normal number for each transition output, kept for the episode, moves it by
    as many deviations everywhere: the draws of outputs whose errors are the same wherever they are asked.
    """

    @property
    @abstractmethod
    def path_size(self) -> int:
        """How many standard normal numbers a draw takes, and how many it is, W."""

    @abstractmethod
    def draw(self, noise: Tensor) -> Tensor:
        """Functions, one a row of standard normal ``noise`` (N, W): (N, W). A pure function of each row, but for the
        last bits."""

    @abstractmethod
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
        """``transition``, where every output follows a function of its own in each row: those of ``paths`` (m, W), of
        which the first ``path_size`` columns count."""


class UncertainHyperparameters(ABC):
    """Functions drawn as if the hyperparameters were uncertain too, which few samples leave them.

    Fallback of ``virtual``: the functions of ``FunctionDraws``, which take one optimum of them for certain.
    """

    @property
    @abstractmethod
    def uncertain_functions(self) -> FunctionDraws:
        """What draws them; the first call in a model's life may take as long as a fit of so few samples. Its compiled
        steps, if any, are those of its own ``CompiledSteps``."""


@dataclass(frozen=True)
class LeaveOneOutErrors:
    """How one output, learned without each sample in turn, foretells it."""

    error: float  # root mean square, in the output's unit
    within_one: float  # share of the samples within one predictive deviation: 0.68 if it tells the truth
    within_two: float  # 0.95


class LeaveOneOut(ABC):
    """Errors on samples that are left out one by one.

    Fallback of ``sampling``: the errors are unknown, None in the fidelity. A design that stops by tested confidence
    then never counts as ready, and spends its budget.
    """

    @abstractmethod
    def leave_one_out(self) -> tuple[LeaveOneOutErrors, ...]:
        """Of each output, (O,). One that never varied makes no error."""


class LearnedNoise(ABC):
    """The noise of a single step that the model has learned beside the function.

    Fallback of ``sampling``: there is none, and no step is taken twice.
    """

    @property
    @abstractmethod
    def noise_deviations(self) -> tuple[float, ...]:
        """Its deviation for each output, in the output's unit, (O,)."""


class OutputOutlook(ABC):
    """One output at m candidates, in its own unit, as if some queries had been answered."""

    learns: Tensor  # (m,) bool: whether a candidate's answer would teach this output anything

    @property
    @abstractmethod
    def deviation(self) -> Tensor:
        """At the candidates, (m,)."""

    @abstractmethod
    def reduction(self, weights: Tensor) -> Tensor:
        """How much each candidate's answer lowers the variance over the reference, weighted by weights (r,): (m,)."""

    @abstractmethod
    def observe(self, index: int) -> OutputOutlook:
        """As if the candidate ``index`` had been answered as well."""


class PathOutlook(ABC):
    """One output along b predicted paths of T steps."""

    learns: Tensor  # (b, T) bool: whether a real step there would teach this output anything

    @property
    @abstractmethod
    def deviation(self) -> Tensor:
        """At each step, in the output's unit, (b, T)."""

    @abstractmethod
    def information(self, weight: Tensor, tolerance: float) -> Tensor:
        """What the steps up to each one tell, in nats, (b, T), for weights (b, T) of the steps and a tolerance in the
        output's unit. A step counts after those before it, so that a repeat tells little."""


@dataclass(frozen=True)
class PredictedSteps:
    """Steps of predicted paths, of shapes (..., C), (..., F) and (..., C)."""

    q: Tensor
    u: Tensor
    q_next: Tensor

    @property
    def flat(self) -> PredictedSteps:
        """The same steps in one row."""
        return PredictedSteps(*(tensor.flatten(0, -2) for tensor in (self.q, self.u, self.q_next)))


class Lookahead(ABC):
    """What further real steps would do to the deviations, before any of them is answered.

    Fallback of ``sampling``: an answer is taken to be correlated with what lies near it, by the distance in deviations
    of the sampling range; along paths the steps count as if they were independent, and a plan does not change the
    model for the next one.
    """

    @abstractmethod
    def outlook(self, candidates: Points, reference: Points, assumed: Points) -> tuple[OutputOutlook | None, ...]:
        """Every output (O,) at m candidates and r reference points, once the queries ``assumed`` are answered; None for
        an output that never varied."""

    @abstractmethod
    def along(self, steps: PredictedSteps, column: int) -> PathOutlook | None:
        """The output ``column`` along steps (b, T, ...); None for one that never varied."""

    @abstractmethod
    def as_if_answered(self, steps: PredictedSteps) -> DynamicsModel:
        """The model as if real steps (T, ...) had been taken as predicted: deviations shrink, means stay."""


class RewardEdges(ABC):
    """Sets of states at whose edges the reward jumps.

    Fallback of ``sampling``: there are none, and no query is spent on them.
    """

    @abstractmethod
    def reward_edge_doubts(self, q: Tensor, q_next: Tensor) -> Iterator[Tensor]:
        """For each edge the chance that the model errs about the side of steps from q (m, C) to q_next (m, C), (m,)."""


class RewardPeaks(ABC):
    """Rewards that are next to nothing nearly everywhere, learned so that where they are highest can be looked for.

    Fallback of ``sampling``: no query is spent on looking.
    """

    @property
    @abstractmethod
    def reward_hides(self) -> bool:
        """Whether the reward is learned so, here."""

    @abstractmethod
    def promise(self, q: Tensor, u: Tensor) -> Tensor:
        """How high the reward of steps from q (m, C) under u (m, F) may be, given what is not known, (m,): in any unit
        that keeps the order, and tells points apart that are paid next to nothing."""


Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ArrayTransition:
    """Predicted step of m points, in arrays."""

    q_next: Floats  # (m, C)
    reward: Floats  # (m,) as in ``Transition``
    deviation: Floats  # (m, O) of what was asked for, the reward's last
    terminated: NDArray[np.bool_]  # (m,)


class ArraySteps(ABC):
    """``transition`` and ``terminated`` of one model, at once. Compared and hashed by identity."""

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
        deviations: bool,
        reward_deviation: bool,
    ) -> ArrayTransition:
        """The step from q (m, C) under u (m, F), in rows; arguments as those of ``transition``, and ``paths``
        (m, W) as in ``transition_along``, for a family that draws functions."""


class CompiledSteps(ABC):
    """Steps by compiled code on arrays of the CPU: the same but for the last bits, in a tenth of the time of few rows.

    Fallback of ``virtual``: ``transition`` and ``terminated``.
    """

    @abstractmethod
    def compiled(self) -> ArraySteps | None:
        """The model's compiled steps; None where this installation can't compile them, or the model is on another
        device. The first call in a process loads compiled code, the first on a machine compiles it."""

    @abstractmethod
    def compiled_pays(self, *, deviations: bool) -> bool:
        """Whether compiled steps are faster, with deviations in every step or without."""


class Differentiable:
    """Nothing to call: ``transition`` can be differentiated by autograd with respect to q and u.

    Fallback of ``gradients``: the search by gradients is refused in one sentence.
    """
