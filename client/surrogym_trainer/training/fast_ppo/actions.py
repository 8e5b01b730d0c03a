"""Initial parameters and derivatives of the action distributions in ``surrogym_shared.distributions``, for learning."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from surrogym_shared import distributions
from surrogym_shared.distributions import Array, Sampled, log_softmax, middle_and_reach
from surrogym_shared.kinds import Activation
from surrogym_trainer.policies.defaults import EXPLORATION


class Distribution(Sampled, Protocol):
    """A distribution of actions (B, F) with the derivatives that a learner needs."""

    @property
    def activation(self) -> Activation:
        """The activation of the hidden layers of actor and critic."""
        ...

    def further(self) -> Array:
        """Return the initial values (K,) of the distribution's parameters that are not outputs of the network."""
        ...

    def arrays(self) -> tuple[tuple[int, ...], Array, Array]:
        """Return, for compiled code, the numbers of choices of discrete actions, and the centre (F,) and the reach
        (F,), half the width, of the bounds of continuous actions. Parts that do not apply are empty."""
        ...

    def slopes(self, outputs: Array, further: Array, actions: Array, by: Array) -> tuple[Array, Array]:
        """Return the derivatives of a loss with respect to the outputs (B, A) and to the further parameters (K,).

        Args:
            outputs: outputs of the actor (B, A).
            further: the distribution's further parameters (K,).
            actions: the actions taken (B, F).
            by: the derivatives of the loss with respect to the log probabilities (B,).
        """
        ...


@dataclass(frozen=True)
class Bounded(distributions.Bounded):
    """Continuous actions within bounds; their standard deviations do not depend on the state."""

    activation: Activation = "tanh"

    def further(self) -> Array:
        """Return the initial logarithms of the standard deviations (F,)."""
        logarithms: Array = np.log(EXPLORATION * self.reach).astype(np.float32)
        return logarithms

    def arrays(self) -> tuple[tuple[int, ...], Array, Array]:
        return (), self.centre, self.reach

    def slopes(self, outputs: Array, further: Array, actions: Array, by: Array) -> tuple[Array, Array]:
        bent = np.tanh(outputs)
        z = (actions - self.centre - self.reach * bent) * np.exp(-further)
        by_mean = by[:, None] * z * np.exp(-further)
        return by_mean * self.reach * (1 - bent * bent), (by[:, None] * (z * z - 1)).sum(0)


@dataclass(frozen=True)
class Choices(distributions.Choices):
    """Discrete actions, with a softmax for each entry."""

    activation: Activation = "relu"

    def further(self) -> Array:
        return np.zeros(0, dtype=np.float32)

    def arrays(self) -> tuple[tuple[int, ...], Array, Array]:
        return self.counts, self.further(), self.further()

    def slopes(self, outputs: Array, further: Array, actions: Array, by: Array) -> tuple[Array, Array]:
        slopes, rows = [], np.arange(len(outputs))
        for i, part in enumerate(self.parts(outputs)):
            slope = -np.exp(log_softmax(part))
            slope[rows, actions[:, i].astype(np.int64)] += 1
            slopes.append(by[:, None] * slope)
        return np.concatenate(slopes, 1), np.zeros_like(further)


def distribution_of(counts: tuple[int, ...], low: NDArray[np.float64], high: NDArray[np.float64]) -> Distribution:
    """Return the distribution of discrete actions with these numbers of choices, or of continuous actions within bounds
    (F,)."""
    if counts:
        return Choices(counts)
    return Bounded(*middle_and_reach(low, high, np.dtype(np.float32)))
