"""The port of dynamics models: all that sampling, virtual, engine and services know of a model.

A family of models is three classes: a ``DynamicsModel``, the ``Learner`` that fits it to samples, and the
``ModelCodec`` that turns it into named arrays and back. Their docstrings are the laws that every family keeps;
``surrogym_server.testing`` checks them. Abilities that only some families have are separate classes in
``models.abilities``.

Shapes: m points, n samples, C coordinates, F action entries, M transition outputs, O = M + 1 outputs in the order of
``definition.outputs``: the increments, then the reward. Every tensor is float64 and lives on ``definition.device``.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from surrogym_server.environment.definition import EnvironmentDefinition
from surrogym_server.environment.samples import Samples
from surrogym_server.errors import InvalidInput
from surrogym_server.tensors import to_device

Warm = Mapping[str, NDArray[np.float64]]  # named arrays that one fit leaves for a warm start of the next
MOST_SAMPLES = 2**31 - 1  # greatest number of samples of a model, the limit of a database's integer column


@dataclass(frozen=True)
class Transition:
    """Predicted step from each of m points."""

    q_next: Tensor  # (m, C) coordinates after the step
    reward: Tensor  # (m,) mean, without the penalty and without the terminal reward; see ``paid``
    std: Tensor | None  # (m, M) standard deviation of each transition output, if requested
    reward_std: Tensor | None  # (m,) standard deviation of the reward, if requested


class DynamicsModel(ABC):
    """Model of one environment, fitted and ready to predict.

    Laws:

    - It is immutable, and a pure function of its samples and settings: the same call gives the same numbers.
    - Predictions of a point do not depend on the points beside it, except for the last bits.
    - Next states are within the environment's limits: they have passed ``step_rules.settle``.
    - Deviations are standard deviations of the unknown function, in each output's own unit: finite, not negative, and
      without the noise of a single step.
    - What the definition declares is not learned: a declared reward is exact and has a standard deviation of 0.
    - A frozen dataclass of tensors, tuples, mappings and dataclasses moves to a device by itself; other classes
      override ``on``.
    """

    definition: EnvironmentDefinition
    terminal_reward: float  # added to the reward of ``transition`` in a step that ends the episode
    samples: int  # number of samples of the fit
    digest: str  # ``Samples.digest`` of the samples of the fit

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
        """Predict the step from q (m, C) under u (m, F): by the mean, or as a sample if ``noise`` is given.

        Args:
            q: coordinates before the step.
            u: action, in the model's units.
            noise: standard normal numbers (m, M). Each transition output is mean + std * noise instead of its
                mean. An output that depends on the prediction of another uses the other's draw.
            process: standard normal numbers (m, M). Each output is also moved by its learned noise (w of eq. 2). A
                family that learns no noise ignores them.
            stds: whether to return the standard deviations of the transition outputs.
            reward_std: whether to return the standard deviation of the reward.
        """

    @abstractmethod
    def means(self, q: Tensor, u: Tensor) -> Tensor:
        """Predict the mean of every output at q (m, C) and u (m, F), (m, O).

        These are the increments before any limit is applied, and the reward including the terminal reward.
        """

    @abstractmethod
    def learned_termination(self, q: Tensor) -> Tensor:
        """Predict the probability (m,) that an episode ends on arriving at q (m, C). Only called if termination is
        learned."""

    def termination_probability(self, q: Tensor) -> Tensor:
        """Return the probability (m,) that an episode ends on arriving at q (m, C): 0 or 1 if termination is
        declared."""
        return self.learned_termination(q) if self.definition.learns_termination else self.terminated(q).to(q.dtype)

    def terminated(self, q: Tensor) -> Tensor:
        """Return whether an episode ends on arriving at q (m, C), (m,) bool."""
        if self.definition.learns_termination:
            return self.learned_termination(q) > 0.5
        return self.definition.terminated(q)

    @property
    @abstractmethod
    def scales(self) -> Tensor:
        """Standard deviation of each output over the samples, (O,), in its own unit; 1 for an output that never
        varied."""

    @property
    @abstractmethod
    def structures(self) -> tuple[str, ...]:
        """Describe the structure of each output's model in a few words, (O,)."""

    @property
    @abstractmethod
    def description(self) -> dict[str, Any]:
        """Describe the model in detail as JSON: ``outputs`` with one entry each, and further fields of the family."""

    def on(self, device: torch.device) -> DynamicsModel:
        """Return the same model with its arrays on ``device``."""
        return self if device == self.definition.device else to_device(self, device)


@dataclass(frozen=True)
class Learned:
    """A fitted model, and named arrays for the warm start of the next fit."""

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
            f"expected a finite terminal_reward and samples from 1 to {MOST_SAMPLES}, got {got}; export the model again"
        )


class ModelCodec(ABC):
    """Conversion of a family's models to data and back, without pickles and without code.

    Laws:

    - ``decode(definition, encode(model))`` predicts the same as the model, bit for bit, and repeats no long
      computation.
    - The header has no entry ``family`` or ``checksum``, which ``models.files`` adds. Names of tensors do not begin
      with ``samples.``, which files of whole surrogates use. Tensors are float64.
    """

    @abstractmethod
    def encode(self, model: DynamicsModel) -> StoredModel:
        """Return everything of a model except its definition.

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

    The settings are the fields of a frozen dataclass: numbers, booleans and strings, as in the specification. An
    invalid setting raises a ValueError that states the allowed values.

    Laws:

    - ``learn`` is a pure function of its arguments and the settings: any randomness in it is seeded.
    - A warm start changes how long a fit takes and which optimum it finds, not what the result means. An empty one
      always works. It consists of named arrays of an earlier fit of the same definition, with fewer samples.
    """

    @property
    @abstractmethod
    def codec(self) -> ModelCodec:
        """Codec of this family's models."""

    @abstractmethod
    def learn(self, definition: EnvironmentDefinition, samples: Samples, warm: Warm | None = None) -> Learned:
        """Fit transition and reward to samples, and termination if that is not declared.

        Raises:
            InvalidInput: too few samples to learn from.
            NumericalFailure: the fit fails on these samples.
        """
