"""Acquisitions: criteria that rate real steps that may be requested (eq. 12 and 13). Packages may add their own.

An acquisition rates candidate steps, or predicted paths, with respect to one output of the model. Its rules:

- it is a pure function of its arguments and its settings: no state, no random numbers of its own;
- it returns one value for each of m candidates (m,), or one for the first 1, 2, ... T steps of each of b paths (b, T);
- larger values are better, and every value is finite;
- it does not change its arguments.

``value_of`` and ``path_value_of`` call the acquisition, and raise an error if its values have a wrong shape or are not
finite.

Its settings are the fields of a frozen dataclass: numbers, booleans and strings, as the specification holds them.
"""

from __future__ import annotations

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
from surrogym_server.models.port import DynamicsModel
from surrogym_server.plugins import Choice, Registry, guarded
from surrogym_server.sampling.confidence import log_model_uncertainty, log_uncertainty_index

GROUP = "surrogym.acquisitions"


@dataclass(frozen=True)
class CandidateView:
    """Properties of m candidate steps (states and actions), such as the model's standard deviations there, from which
    an acquisition rates them with respect to one output of the model."""

    model: DynamicsModel
    points: Points  # the m candidates: states and actions
    output: int  # index of the output in ``definition.outputs``
    tolerance: float  # error that is too small to matter, in the output's unit
    # (m,) standard deviation without noise, in the output's unit, as if all earlier queries had been answered.
    std: Tensor
    distance: Tensor  # (m,) distance to the nearest query so far, in standard deviations of the sampling range
    # (m,) logarithm of how likely a policy is to visit each candidate, the paper's input probability (eq. 11); 0 unless
    # the acquisition sets ``reads_probability``.
    log_probability: Tensor
    _reduction: Callable[[], Tensor]

    @cached_property
    def variance_reduction(self) -> Tensor:
        """How much a real step at each candidate would reduce the weighted variance over the reference points, (m,).
        Only an acquisition whose class attribute ``reads_reference`` is True may use it."""
        return self._reduction()


@dataclass(frozen=True)
class PathView:
    """Properties of b predicted paths of T steps, such as the information that their steps give, from which an
    acquisition rates them with respect to one output of the model."""

    tolerance: float  # error that is too small to matter, in the output's unit
    # (b, T) weight of each step, at least 0: 0 outside the sampling range, and smaller where the path is uncertain.
    weight: Tensor
    _std: Callable[[], Tensor]
    _information: Callable[[], Tensor]

    @cached_property
    def std(self) -> Tensor:
        """Standard deviation without noise at each step, in the output's unit, (b, T)."""
        return self._std()

    @cached_property
    def information(self) -> Tensor:
        """Information about the output, in nats, that the first 1, 2, ... T steps of each path give, (b, T)."""
        return self._information()


class Acquisition(ABC):
    """Criterion that rates candidates for the next real steps. The docstring of this module has the rules for its
    subclasses."""

    adaptive: ClassVar[bool] = True  # if False, all steps of the budget are requested before the first fit of a model
    reads_reference: ClassVar[bool] = False  # whether the acquisition uses ``variance_reduction``
    reads_probability: ClassVar[bool] = False  # whether the acquisition uses ``log_probability``

    def check(self, definition: EnvironmentDefinition) -> None:  # noqa: B027  most take every environment
        """Check that the criterion's settings fit the environment. It is called once, when a surrogate is registered,
        before any real step.

        Raises:
            ValueError: the settings don't fit; the message says what was expected and what came.
        """

    @abstractmethod
    def value(self, candidates: CandidateView) -> Tensor:
        """Return the value of a real step at each of m candidates, (m,). The step with the largest value is
        requested."""

    def path_value(self, paths: PathView) -> Tensor:
        """Return the value of the first 1, 2, ... T steps of each of b paths, (b, T). More steps never have less value.

        By default it is the information about the output that these steps give together.
        """
        return paths.information


@dataclass(frozen=True)
class IntegratedVariance(Acquisition):
    """Criterion: by how much a real step at the candidate would reduce the variance at reference points, which are
    spread over the sampling range and the states that policies visited.

    The model computes the reduction: ``ProcessOutlook.reduction`` of ``models.gaussian_process.prediction.lookahead``,
    or ``NearbyAnswers`` of ``sampling.lookahead`` for models without lookahead. This is the default acquisition, which
    ``surrogym_shared.presets`` chooses.

    Reference: D. Cohn (1993), NIPS 6.
    """

    reads_reference: ClassVar[bool] = True

    def value(self, candidates: CandidateView) -> Tensor:
        return candidates.variance_reduction


@dataclass(frozen=True)
class Variance(Acquisition):
    """Criterion: the standard deviation (without noise) of the output at the candidate."""

    def value(self, candidates: CandidateView) -> Tensor:
        return candidates.std

    def path_value(self, paths: PathView) -> Tensor:
        return (paths.weight * paths.std).cumsum(-1)


@dataclass(frozen=True)
class UncertaintyIndex(Acquisition):
    """Criterion of the paper: the uncertainty index, log U = log U_m + log P_i (eq. 12), with the model uncertainty U_m
    and the input probability P_i."""

    reads_probability: ClassVar[bool] = True

    def value(self, candidates: CandidateView) -> Tensor:
        log_u_m = log_model_uncertainty(candidates.std, candidates.tolerance)
        return log_uncertainty_index(log_u_m, candidates.log_probability)

    def path_value(self, paths: PathView) -> Tensor:
        return (paths.weight * log_model_uncertainty(paths.std, paths.tolerance).exp()).cumsum(-1)


@dataclass(frozen=True)
class LatinHypercube(Acquisition):
    """Criterion of a design that is not adaptive: all steps of the budget form one Latin hypercube. If more steps are
    requested, each is as far as possible from all earlier ones."""

    adaptive: ClassVar[bool] = False

    def value(self, candidates: CandidateView) -> Tensor:
        return candidates.distance.nan_to_num()  # the distance is infinite before the first query


ACQUISITIONS: Registry[Acquisition] = Registry(
    "acquisition",
    GROUP,
    Acquisition,
    {
        "integrated_variance": IntegratedVariance,
        "variance": Variance,
        "uncertainty_index": UncertaintyIndex,
        "latin_hypercube": LatinHypercube,
    },
)


def acquisition_of(choice: Choice) -> Acquisition:
    """Return the acquisition that has the name and the settings of ``choice``. Raises ``InvalidSpec`` for an unknown
    name or setting."""
    return ACQUISITIONS.make(choice)


def check_acquisition(definition: EnvironmentDefinition) -> None:
    """Raise ``InvalidSpec`` unless the definition's acquisition exists, takes its settings and fits the
    environment."""
    choice = definition.design.acquisition
    acquisition = acquisition_of(choice)
    with guarded(f"acquisition {choice.name}", InvalidSpec):
        acquisition.check(definition)


def value_of(choice: Choice, candidates: CandidateView) -> Tensor:
    """Return the value that the acquisition ``choice`` gives to each of m candidates, (m,). Raises ``ChoiceFailed`` if
    the acquisition fails or the values are not m finite numbers."""
    return _criterion_values(choice, acquisition_of(choice).value, candidates, candidates.distance.shape)


def path_value_of(choice: Choice, paths: PathView) -> Tensor:
    """Return the value that the acquisition ``choice`` gives to the first 1, 2, ... T steps of each of b paths, (b, T).
    Raises ``ChoiceFailed`` if the acquisition fails or the values are not finite numbers of this shape."""
    return _criterion_values(choice, acquisition_of(choice).path_value, paths, paths.weight.shape)


def _criterion_values(choice: Choice, criterion: Callable[[Any], Tensor], view: Any, shape: torch.Size) -> Tensor:
    what = f"the choice of the next queries failed: acquisition {choice.name}"
    with guarded(what, ChoiceFailed):
        values: object = criterion(view)
    if not isinstance(values, Tensor):
        raise ChoiceFailed(
            f"{what}: expected a tensor of shape {tuple(shape)}, got {type(values).__name__}; "
            "correct the values that this acquisition returns"
        )
    if values.shape != shape:
        raise ChoiceFailed(
            f"{what}: expected a tensor of shape {tuple(shape)}, got {tuple(values.shape)}; "
            "correct the values that this acquisition returns"
        )
    if bad := int((~values.isfinite()).sum()):
        raise ChoiceFailed(
            f"{what}: expected finite values, got {bad} of {values.numel()} that are infinite or NaN; "
            "correct the values that this acquisition returns"
        )
    return values
