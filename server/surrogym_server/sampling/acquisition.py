"""Acquisitions: criteria that value a query (eq. 12 and 13). One class for each criterion; packages may add their own.

An acquisition values candidates, or predicted paths, with respect to one output of the model. Its laws:

- it is a pure function of its arguments and its settings: no state, no random numbers of its own;
- it returns one value for each candidate (m,), or for each beginning of each path (b, T); only their order counts;
- larger values are better, and every value is finite;
- it does not change its arguments.

``value_of`` and ``path_value_of`` call it, and raise if the values have another shape or are not finite.

Its settings are the fields of a frozen dataclass: numbers, booleans and strings, as the specification holds them.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import torch
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.points import Points
from surrogym_server.errors import ChoiceFailed, InvalidSpec
from surrogym_server.models.abilities import OutputOutlook, PathOutlook
from surrogym_server.models.port import DynamicsModel
from surrogym_server.plugins import Choice, Registry, guarded
from surrogym_server.sampling.confidence import log_model_uncertainty, log_uncertainty_index

GROUP = "surrogym.acquisitions"
MOST_TRAJECTORIES, LONGEST_TRAJECTORY = 100, 1_000  # limits of settings

Outlooks = tuple[OutputOutlook | None, ...]  # of every output (O,); None for one that never varied


@dataclass(frozen=True)
class CandidateView:
    """View of m candidates that an acquisition reads, with respect to one output."""

    model: DynamicsModel
    points: Points  # m states and actions
    output: int  # number of the output, in the order of the definition
    tolerance: float  # of the output, in its unit
    deviation: Tensor  # (m,) latent, in the output's unit, as if all pending queries had been answered
    distance: Tensor  # (m,) to the nearest query so far, in deviations of the sampling range
    log_probability: Tensor  # (m,) log P_i (eq. 11); 0 unless the acquisition reads it
    _reduction: Callable[[], Tensor]
    tolerances: tuple[float, ...] = ()  # of every output (O,), in its unit
    _outlook: Outlooks = ()
    _given_optimal: tuple[Outlooks, ...] = ()

    @cached_property
    def deviations(self) -> Tensor:
        """Latent deviation of every output, as ``deviation``; 0 where an answer would teach this output nothing,
        (O, m)."""
        return self._each(self._outlook)

    @cached_property
    def deviations_given_optimal(self) -> Tensor:
        """``deviations`` as if the steps of one optimal trajectory had been answered too, for each of S, (S, O, m).

        S is the acquisition's ``trajectories``.
        """
        each = [self._each(outlook) for outlook in self._given_optimal]
        return torch.stack(each) if each else self.deviations.new_zeros(0, *self.deviations.shape)

    def _each(self, outlook: Outlooks) -> Tensor:
        none = torch.zeros_like(self.deviation)
        return torch.stack([none if output is None else output.deviation * output.learns for output in outlook])

    @cached_property
    def variance_reduction(self) -> Tensor:
        """Reduction of the weighted variance over the reference by an answer at each candidate, (m,); see
        ``reads_reference``."""
        return self._reduction()


@dataclass(frozen=True)
class PathView:
    """View of b predicted paths of T steps that an acquisition reads, with respect to one output."""

    tolerance: float  # of the output, in its unit
    weight: Tensor  # (b, T) at least 0; depends on where the step lies and how well it can be predicted
    _deviation: Callable[[], Tensor]
    _information: Callable[[], Tensor]
    _given_optimal: tuple[PathOutlook, ...] = ()

    @cached_property
    def deviation_given_optimal(self) -> Tensor:
        """``deviation`` as if the steps of one optimal trajectory had been answered, for each of S, (S, b, T)."""
        return self._stacked([outlook.deviation for outlook in self._given_optimal])

    @cached_property
    def information_given_optimal(self) -> Tensor:
        """``information`` as if the steps of one optimal trajectory had been answered, for each of S, (S, b, T)."""
        return self._stacked([outlook.information(self.weight, self.tolerance) for outlook in self._given_optimal])

    def _stacked(self, each: list[Tensor]) -> Tensor:
        return torch.stack(each) if each else self.weight.new_zeros(0, *self.weight.shape)

    @cached_property
    def deviation(self) -> Tensor:
        """Latent deviation at each step, in the output's unit, (b, T)."""
        return self._deviation()

    @cached_property
    def information(self) -> Tensor:
        """Information about the output in the beginning of each path, up to each step, in nats, (b, T)."""
        return self._information()


class Acquisition(ABC):
    """One criterion. It follows the laws of the module.

    An acquisition with ``trajectories`` reads what optimal trajectories would teach. The design then draws as many
    functions from the posterior, and plans the trajectory of ``horizon`` steps with the highest return in each. Planned
    paths follow drawn functions too, and not the mean.

    An acquisition with ``optimism`` plans paths with the luck that suits it best: in each step a plan chooses, beside
    the action, by how many deviations each transition output misses its mean, at most ``optimism`` of them. Then no
    path follows a drawn function.
    """

    trajectories: int = 0  # number of drawn optimal trajectories that it reads
    horizon: int = 0  # steps of each of them, at most; an episode may end before
    optimism: float = 0.0  # deviations
    adaptive: ClassVar[bool] = True  # False: the whole budget is queried before the first fit
    reads_reference: ClassVar[bool] = False  # whether it uses ``variance_reduction``
    reads_probability: ClassVar[bool] = False  # whether it uses ``log_probability``

    def check(self, definition: EnvironmentDefinition) -> None:  # noqa: B027  most take every environment
        """Check that the settings fit the environment; called once, when a surrogate is registered, before any real
        step.

        Raises:
            ValueError: they don't fit; the message says what was expected and what came.
        """

    @abstractmethod
    def value(self, candidates: CandidateView) -> Tensor:
        """Value of asking each candidate, (m,)."""

    def path_value(self, paths: PathView) -> Tensor:
        """Value of following each path up to each step, (b, T). It does not decrease along a path.

        The default sums the information of the steps, each given those before it, whatever the criterion for candidates
        is.
        """
        return paths.information


@dataclass(frozen=True)
class IntegratedVariance(Acquisition):
    """Reduction of the variance over the sampling range and the visited states by an answer.

    Reference: D. Cohn (1993), NIPS 6.
    """

    reads_reference: ClassVar[bool] = True

    def value(self, candidates: CandidateView) -> Tensor:
        return candidates.variance_reduction


@dataclass(frozen=True)
class Variance(Acquisition):
    """Deviation at the candidate."""

    def value(self, candidates: CandidateView) -> Tensor:
        return candidates.deviation

    def path_value(self, paths: PathView) -> Tensor:
        return (paths.weight * paths.deviation).cumsum(-1)


@dataclass(frozen=True)
class UncertaintyIndex(Acquisition):
    """The uncertainty index of the paper, log U = log U_m + log P_i (eq. 12)."""

    reads_probability: ClassVar[bool] = True

    def value(self, candidates: CandidateView) -> Tensor:
        log_u_m = log_model_uncertainty(candidates.deviation, candidates.tolerance)
        return log_uncertainty_index(log_u_m, candidates.log_probability)

    def path_value(self, paths: PathView) -> Tensor:
        return (paths.weight * log_model_uncertainty(paths.deviation, paths.tolerance).exp()).cumsum(-1)


@dataclass(frozen=True)
class LatinHypercube(Acquisition):
    """No criterion: the whole budget is one Latin hypercube. Queries beyond it fill the largest gaps."""

    adaptive: ClassVar[bool] = False

    def value(self, candidates: CandidateView) -> Tensor:
        return candidates.distance.nan_to_num()  # infinite before the first query


@dataclass(frozen=True)
class BARL(Acquisition):
    """Information that one answer gives about the optimal trajectory, summed over the outputs, in nats:

        EIG(x) = H[y | D] - E H[y | D, tau*],    y = f(x) + noise,

    with the expectation over optimal trajectories tau* of functions drawn from the posterior. For a Gaussian process
    both entropies are those of normal distributions, and the difference is a mean over the trajectories and a sum over
    the outputs of 1/2 log((sigma^2 + tau^2) / (sigma_s^2 + tau^2)). sigma and sigma_s are the deviations of the latent
    function before and after trajectory s is known. The noise's deviation tau is the output's tolerance, which is at
    least the noise of a step that was found.

    Along planned paths the steps are summed as if each were the only answer (the sTIP of the second reference).

    References: V. Mehta, B. Paria, J. Schneider, S. Ermon, W. Neiswanger (2022), An Experimental Design Perspective on
    Model-Based Reinforcement Learning, ICLR. For the sum along paths: V. Mehta et al. (2022), as for ``TIP``.
    """

    trajectories: int = 8
    horizon: int = 50

    def __post_init__(self) -> None:
        _check_count("trajectories", self.trajectories, MOST_TRAJECTORIES)
        _check_count("horizon", self.horizon, LONGEST_TRAJECTORY)

    def value(self, candidates: CandidateView) -> Tensor:
        noise = candidates.deviations.new_tensor(candidates.tolerances)[:, None]
        known = (candidates.deviations_given_optimal / noise).square().log1p()
        return 0.5 * ((candidates.deviations / noise).square().log1p() - known).sum(1).mean(0)

    def path_value(self, paths: PathView) -> Tensor:
        scale = paths.weight / paths.tolerance
        known = (scale * paths.deviation_given_optimal).square().log1p()
        gain = 0.5 * ((scale * paths.deviation).square().log1p() - known).mean(0)
        return gain.clamp_min(0).cumsum(-1)


@dataclass(frozen=True)
class TIP(BARL):
    """Information that the answers of a whole sequence of steps give about the optimal trajectory, jointly, in nats:

        C(x_1..x_t) = H[y_1..y_t | D] - E H[y_1..y_t | D, tau*].

    Both are joint entropies of normal distributions, 1/2 log det of the covariance of the answers at the points of the
    path, with the noise of ``BARL``. The path is that of a function drawn from the posterior, and the value of an
    action sequence is the mean over these functions.

    For single queries the value is that of ``BARL``. A batch is chosen greedily, each query given those before it, so
    the values add up to the joint gain of the batch (chain rule of entropies).

    Reference: V. Mehta, I. Char, J. Abbate, R. Conlin, M. Boyer, S. Ermon, J. Schneider, W. Neiswanger (2022),
    Exploration via Planning for Information about the Optimal Trajectory, NeurIPS.
    """

    def path_value(self, paths: PathView) -> Tensor:
        return (paths.information - paths.information_given_optimal).mean(0)


@dataclass(frozen=True)
class OPAX(Acquisition):
    """Bound on the information about all of the dynamics that the steps of a path give, in nats, times two:

        sum_t sum_j log(1 + sigma_j(x_t, u_t)^2 / tau_j^2),

    with the noise's deviation tau of ``BARL``. Paths are optimistic: x_{t+1} = mean + ``optimism`` * sigma * eta, where
    eta in [-1, 1], one number for each transition output, is planned like the actions (the hallucinated controls).

    For single queries there is no path, and the value is the sum over the outputs at the candidate.

    Reference: B. Sukhija, L. Treven, C. Sancaktar, S. Blaes, S. Coros, A. Krause (2023), Optimistic Active Exploration
    of Dynamical Systems, NeurIPS.
    """

    optimism: float = 1.0

    def __post_init__(self) -> None:
        if not 0 < self.optimism < math.inf:
            raise ValueError(f"expected a positive optimism, got {self.optimism}")

    def value(self, candidates: CandidateView) -> Tensor:
        noise = candidates.deviations.new_tensor(candidates.tolerances)[:, None]
        return (candidates.deviations / noise).square().log1p().sum(0)

    def path_value(self, paths: PathView) -> Tensor:
        return (paths.weight * paths.deviation / paths.tolerance).square().log1p().cumsum(-1)


def _check_count(name: str, count: int, most: int) -> None:
    if not 1 <= count <= most:
        raise ValueError(f"expected {name} between 1 and {most}, got {count}")


ACQUISITIONS: Registry[Acquisition] = Registry(
    "acquisition",
    GROUP,
    Acquisition,
    {
        "integrated_variance": IntegratedVariance,
        "variance": Variance,
        "uncertainty_index": UncertaintyIndex,
        "latin_hypercube": LatinHypercube,
        "barl": BARL,
        "tip": TIP,
        "opax": OPAX,
    },
)


def acquisition_of(choice: Choice) -> Acquisition:
    """Return the acquisition with a name and settings. Raises ``InvalidSpec``."""
    return ACQUISITIONS.make(choice)


def check_acquisition(definition: EnvironmentDefinition) -> None:
    """Check that an acquisition exists, takes these settings, and fits the environment. Raises ``InvalidSpec``."""
    choice = definition.design.acquisition
    acquisition = acquisition_of(choice)
    with guarded(f"acquisition {choice.name}", InvalidSpec):
        acquisition.check(definition)


def value_of(choice: Choice, candidates: CandidateView) -> Tensor:
    """Return the acquisition's value of each of m candidates, (m,). Raises ``ChoiceFailed`` if it breaks the laws."""
    return _criterion_values(choice, acquisition_of(choice).value, candidates, candidates.distance.shape)


def path_value_of(choice: Choice, paths: PathView) -> Tensor:
    """Return the acquisition's value of each beginning of b paths, (b, T). Raises ``ChoiceFailed`` if it breaks the
    laws."""
    return _criterion_values(choice, acquisition_of(choice).path_value, paths, paths.weight.shape)


def _criterion_values(choice: Choice, criterion: Callable[[Any], Tensor], view: Any, shape: torch.Size) -> Tensor:
    what = f"the choice of the next queries failed: acquisition {choice.name}"
    with guarded(what, ChoiceFailed):
        values: object = criterion(view)
    if not isinstance(values, Tensor):
        raise ChoiceFailed(f"{what}: expected a tensor of shape {tuple(shape)}, got {type(values).__name__}")
    if values.shape != shape:
        raise ChoiceFailed(f"{what}: expected a tensor of shape {tuple(shape)}, got {tuple(values.shape)}")
    if bad := int((~values.isfinite()).sum()):
        raise ChoiceFailed(f"{what}: expected finite values, got {bad} of {values.numel()} that are infinite or NaN")
    return values
