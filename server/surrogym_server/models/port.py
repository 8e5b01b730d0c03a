"""The interface of dynamics models: the rest of the server uses a model only by these classes.

A family of models consists of three classes: a ``DynamicsModel``, the ``Learner`` that fits it to samples, and the
``ModelCodec`` that converts it to named arrays and back. Their docstrings state the laws, the rules that every family
obeys; ``surrogym_server.testing`` checks them. Abilities that only some families have are separate classes in
``models.abilities``.

Letters of shapes: m points, n samples, C coordinates, F action entries, M transition outputs (changes of coordinates or
of observation entries), O = M + 1 outputs in the order of ``definition.outputs``: the transition outputs, then the
reward. Every tensor is float64 and on ``definition.device``.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.samples import Samples
from surrogym_server.errors import InvalidInput
from surrogym_server.tensors import to_device

Warm = Mapping[str, NDArray[np.float64]]  # named arrays of one fit, from which the next fit can start (warm start)
MOST_SAMPLES = 2**31 - 1  # greatest number of samples of a model, the limit of a database's integer column


@dataclass(frozen=True)
class Transition:
    """Predicted step from each of m points."""

    q_next: Tensor  # (m, C) coordinates after the step
    # (m,) mean reward, without the terminal reward, which ``step_rules.paid`` adds, and without an uncertainty penalty.
    reward: Tensor
    std: Tensor | None  # (m, M) standard deviation of each transition output, if requested
    reward_std: Tensor | None  # (m,) standard deviation of the reward, if requested


class DynamicsModel(ABC):
    """Model of one environment, fitted and ready to predict.

    Laws (rules that every model obeys):

    - It is immutable, and a pure function of its samples and settings: the same call gives the same numbers.
    - Except for rounding errors, the prediction at a point does not depend on the other points of the same call.
    - Next states obey the environment's rules: ``step_rules.settle`` has been applied to them.
    - Standard deviations are those of the unknown function, without the noise of a single step. They are finite, not
      negative and in the unit of each output.
    - A reward or termination that the definition declares is not learned. So a declared reward has a standard deviation
      of 0 at a known state.
    - A model that is a frozen dataclass of tensors, tuples, mappings and dataclasses inherits ``on``; other classes
      override it.
    """

    definition: EnvironmentDefinition
    terminal_reward: float  # reward that a step that ends the episode gives in addition to the reward of ``transition``
    samples: int  # number of samples to which the model was fitted
    digest: str  # ``Samples.digest`` of the samples to which the model was fitted

    @abstractmethod
    def transition(
        self,
        q: Tensor,
        u: Tensor,
        *,
        noise: Tensor | None = None,
        process: Tensor | None = None,
        stds: bool = False,
        reward_std: bool = False,
    ) -> Transition:
        """Predict the step from q (m, C) under u (m, F). By default the outputs have their mean values; with ``noise``
        they are sampled.

        Args:
            q: coordinates before the step.
            u: action, in the model's units.
            noise: standard normal numbers (m, M). Each transition output is mean + std * noise instead of its mean. If
                an output depends on the predicted value of another output, it uses the other's sampled value.
            process: standard normal numbers (m, M), by which the learned noise (w of eq. 2) moves each transition
                output. A family that learns no noise ignores them.
            stds: whether to return the standard deviations of the transition outputs.
            reward_std: whether to return the standard deviation of the reward.
        """

    @abstractmethod
    def means(self, q: Tensor, u: Tensor) -> Tensor:
        """Predict the mean (m, O) of every output at q (m, C) and u (m, F).

        The outputs are the increments before limits are applied, and the reward with the terminal reward.
        """

    @abstractmethod
    def learned_termination(self, q: Tensor) -> Tensor:
        """Predict the probability (m,) that an episode ends on arriving at q (m, C). Only called if termination is
        learned."""

    def termination_probability(self, q: Tensor) -> Tensor:
        """Return the probability (m,) that an episode ends on arriving at q (m, C). It is 0 or 1 if termination is
        declared."""
        return self.learned_termination(q) if self.definition.learns_termination else self.terminated(q).to(q.dtype)

    def terminated(self, q: Tensor) -> Tensor:
        """Return (m,) bool: whether the model predicts that an episode ends on arriving at q (m, C)."""
        if self.definition.learns_termination:
            return self.learned_termination(q) > 0.5
        return self.definition.terminated(q)

    @property
    @abstractmethod
    def scales(self) -> Tensor:
        """Standard deviation of each output over the samples, (O,), in the output's unit; 1 for an output that never
        varied."""

    @property
    @abstractmethod
    def structures(self) -> tuple[str, ...]:
        """Describe the structure of each output's model in a few words, (O,)."""

    @property
    @abstractmethod
    def description(self) -> dict[str, Any]:
        """Describe the model in detail, as values for JSON: ``outputs``, a list with one entry for each output, and
        further fields of the family."""

    def on(self, device: torch.device) -> DynamicsModel:
        """Return the same model with its arrays on ``device``."""
        return self if device == self.definition.device else to_device(self, device)

    @cached_property
    def _by_set_points(self) -> dict[tuple[tuple[str, float], ...], DynamicsModel]:
        """The models that ``with_set_points`` has made of this one."""
        return {}


MOST_SET_POINTS = 16  # largest number of sets of set points for which a model keeps a copy of itself


def with_set_points(model: DynamicsModel, points: tuple[tuple[str, float], ...]) -> DynamicsModel:
    """Return the same model for other set points of the declared reward, given by coordinate.

    Raises:
        InvalidInput: the reward or the model does not support a set point, with the reason.
    """
    if not points:
        return model
    known = model._by_set_points
    if (found := known.get(points)) is None:
        of_any: Any = model
        if not hasattr(model, "__dataclass_fields__"):
            raise InvalidInput(
                f"set points: expected a model that is a dataclass, got {type(model).__name__}: leave them out"
            )
        found = replace(of_any, definition=model.definition.with_set_points(points))
        if len(known) >= MOST_SET_POINTS:
            known.clear()
        known[points] = found
    return found


@dataclass(frozen=True)
class Learned:
    """Result of a fit: the model, and named arrays from which the next fit can start (warm start)."""

    model: DynamicsModel
    warm: dict[str, NDArray[np.float64]]


@dataclass(frozen=True)
class StoredModel:
    """A model as data: a header that JSON can represent, and named tensors."""

    header: dict[str, Any]
    tensors: dict[str, Tensor]


def require_format(got: object, expected: int) -> None:
    """Raise ``InvalidInput`` unless a stored model has the format number that this version writes."""
    if got != expected:
        raise InvalidInput(
            f"expected a model of format {expected}, got format {str(got)[:80]}, which another version wrote: "
            "export its samples with that version, and learn from them again"
        )


def require_sums(terminal_reward: float, samples: int) -> None:
    """Raise ``InvalidInput`` unless the terminal reward is finite and the number of samples is one that a fit can
    have."""
    if not math.isfinite(terminal_reward) or not 1 <= samples <= MOST_SAMPLES:
        got = f"{terminal_reward} and {samples if abs(samples) <= MOST_SAMPLES else 'more'}"
        raise InvalidInput(
            f"expected a model with a finite terminal_reward and samples from 1 to {MOST_SAMPLES}, got {got}; "
            "export the model again"
        )


class ModelCodec(ABC):
    """Conversion of a family's models to data and back, without pickles and without code.

    Laws (rules that every codec obeys):

    - ``decode(definition, encode(model))`` predicts exactly the same numbers as the model, and repeats no long
      computation.
    - The header has no entry ``family`` or ``checksum``, which ``models.files`` adds. Names of tensors do not begin
      with ``samples.``, which files of whole surrogates use. Tensors are float64.
    """

    @abstractmethod
    def encode(self, model: DynamicsModel) -> StoredModel:
        """Return a model as data, without its definition.

        Raises:
            TypeError: the model belongs to another family.
        """

    @abstractmethod
    def decode(self, definition: EnvironmentDefinition, stored: StoredModel) -> DynamicsModel:
        """Rebuild the model of a definition. The data may come from anybody, so every number and shape is checked.

        Raises:
            InvalidInput: the data are well formed, but not a model of this environment.
            LookupError, TypeError, ValueError, AttributeError, OverflowError: the data are malformed; the caller turns
                this into a message.
        """


class Learner(ABC):
    """Learning algorithm of a family of models.

    A learner is a frozen dataclass. Its fields are the settings in the specification: numbers, booleans and strings. An
    invalid setting raises a ValueError that states the allowed values.

    Laws (rules that every learner obeys):

    - ``learn`` is a pure function of its arguments and the settings: any randomness in it is seeded.
    - A warm start consists of named arrays from an earlier fit of the same definition to fewer samples; it may be
      empty. It only influences how long a fit takes and which optimum the fit finds.
    """

    @property
    @abstractmethod
    def codec(self) -> ModelCodec:
        """Codec of this family's models."""

    @abstractmethod
    def learn(self, definition: EnvironmentDefinition, samples: Samples, warm: Warm | None = None) -> Learned:
        """Fit a model of transition and reward to samples, and of termination if termination is not declared.

        Raises:
            InvalidInput: too few samples to learn from.
            NumericalFailure: the fit fails on these samples.
        """
