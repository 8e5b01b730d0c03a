"""The port of dynamics models: what sampling, virtual, engine and services may know of a model.

A family of models is three classes: a ``DynamicsModel``, the ``Learner`` that makes it from samples, and the
``ModelCodec`` that turns it into named arrays and back. Their docstrings are the laws that every family keeps;
``surrogym_server.testing`` checks them. What only some families can do is a class of its own in ``models.abilities``.

Shapes: m points, n samples, C coordinates, F action entries, M transition outputs, O = M + 1 outputs in the order of
``definition.outputs``: the increments, then the reward. Every tensor is float64 and lives on ``definition.device``.
"""

from __future__ import annotations

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
from surrogym_server.tensors import to_device

Warm = Mapping[str, NDArray[np.float64]]  # what one fit leaves for the next, as named arrays


@dataclass(frozen=True)
class Transition:
    """Predicted step of m points."""

    q_next: Tensor  # (m, C)
    reward: Tensor  # (m,) mean, without penalty and without what a step that ends the episode pays; see ``paid``
    deviation: Tensor | None  # (m, M) of each transition output, if asked for
    reward_deviation: Tensor | None  # (m,) if asked for


class DynamicsModel(ABC):
    """One fit of one environment, ready to predict.

    Laws:

    - It is immutable, and a pure function of what it was learned from: the same call gives the same numbers.
    - Predictions of a point do not depend on the points beside it, but for the last bits.
    - Next states are where the environment can be: they have passed ``step_rules.settle``.
    - Deviations are those of what the model does not know, in each output's own unit: finite, not negative, and
      without the noise of a single step.
    - What the definition declares is not learned: a declared reward is exact and deviates by 0.
    - A frozen dataclass of tensors, tuples, mappings and dataclasses moves to a device by itself; other classes
      override ``on``.
    """

    definition: EnvironmentDefinition
    terminal_reward: float  # what a step that ends the episode pays beyond the reward of ``transition``
    samples: int  # how many it was learned from
    digest: str  # ``Samples.digest`` of them

    @abstractmethod
    def transition(
        self,
        q: Tensor,
        u: Tensor,
        *,
        noise: Tensor | None = None,
        process: Tensor | None = None,
        deviations: bool = False,
        reward_deviation: bool = False,
    ) -> Transition:
        """The step from q (m, C) under u (m, F): the mean's, or one draw with noise.

        Args:
            q: where it begins.
            u: the action, in the model's units.
            noise: (m, M), standard normal: each transition output is mean + deviation * noise, instead of its mean;
                one that reads the prediction of another reads its draw.
            process: (m, M), standard normal: each is moved by its learned noise as well (w of eq. 2). A family that
                learns no noise ignores it.
            deviations: whether to give the deviations of the transition outputs.
            reward_deviation: whether to give that of the reward.
        """

    @abstractmethod
    def means(self, q: Tensor, u: Tensor) -> Tensor:
        """Mean of every output at q (m, C) and u (m, F), (m, O): increments before any limit, and the reward with what
        an end pays."""

    @abstractmethod
    def learned_termination(self, q: Tensor) -> Tensor:
        """How likely an episode ends on arriving at q (m, C), (m,), where that is learned; not called elsewhere."""

    def termination_probability(self, q: Tensor) -> Tensor:
        """How likely an episode ends on arriving at q (m, C), (m,): 0 or 1 where termination is declared."""
        return self.learned_termination(q) if self.definition.learns_termination else self.terminated(q).to(q.dtype)

    def terminated(self, q: Tensor) -> Tensor:
        """Whether an episode ends on arriving at q (m, C), (m,) bool."""
        if self.definition.learns_termination:
            return self.learned_termination(q) > 0.5
        return self.definition.terminated(q)

    @property
    @abstractmethod
    def scales(self) -> Tensor:
        """Deviation of each output's targets over the samples, (O,), in its own unit; 1 for one that never varied."""

    @property
    @abstractmethod
    def structures(self) -> tuple[str, ...]:
        """What represents each output, in a few words for people, (O,)."""

    @property
    @abstractmethod
    def description(self) -> dict[str, Any]:
        """The model in detail, for people, as JSON: ``outputs``, one entry each, and whatever else there is to say."""

    def on(self, device: torch.device) -> DynamicsModel:
        """The same model with its arrays on a device."""
        return self if device == self.definition.device else to_device(self, device)


@dataclass(frozen=True)
class Learned:
    """A model, and named arrays for the next fit's warm start."""

    model: DynamicsModel
    warm: dict[str, NDArray[np.float64]]


@dataclass(frozen=True)
class StoredModel:
    """A model as data: a header that JSON can carry, and named tensors."""

    header: dict[str, Any]
    tensors: dict[str, Tensor]


class ModelCodec(ABC):
    """A model as data and back. Never a pickle, never code.

    Laws:

    - ``decode(definition, encode(model))`` predicts what the model does, bit for bit, and recomputes nothing that
      takes long.
    - Names of the header are not ``family`` nor ``checksum``, which ``models.files`` writes; names of tensors do not
      begin with ``samples.``, which files of whole surrogates use. Tensors are float64.
    """

    @abstractmethod
    def encode(self, model: DynamicsModel) -> StoredModel:
        """All of a model but its definition. Raises TypeError for a model of another family."""

    @abstractmethod
    def decode(self, definition: EnvironmentDefinition, stored: StoredModel) -> DynamicsModel:
        """The model of a definition. What comes may be anybody's: every number and shape is checked.

        Raises:
            InvalidInput: well formed, and no model of this environment.
            LookupError, TypeError, ValueError, AttributeError, OverflowError: malformed; the caller says so in words.
        """


class Learner(ABC):
    """How a family learns. Its settings are the fields of a frozen dataclass: numbers, booleans and strings, as the
    specification carries them; a setting that it can't take is a ValueError that says what it takes.

    Laws:

    - ``learn`` is a pure function of its arguments and the settings: what is random in it is seeded.
    - A warm start changes how long a fit takes and which optimum it finds, not what it means; an empty one always
      works. What is in it is named arrays of an earlier fit of the same definition, with fewer samples.
    """

    @property
    @abstractmethod
    def codec(self) -> ModelCodec:
        """What stores this family's models."""

    @abstractmethod
    def learn(self, definition: EnvironmentDefinition, samples: Samples, warm: Warm | None = None) -> Learned:
        """Fit transition and reward to samples, and where episodes end if that is not declared.

        Raises:
            InvalidInput: too few samples to learn from.
            NumericalFailure: the fit fails on these samples.
        """
