"""Learning the action distributions of ``surrogym_shared.distributions``: initial parameters and derivatives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from surrogym_shared import distributions
from surrogym_shared.distributions import Array, Sampled, log_softmax, middle_and_reach
from surrogym_shared.network import Activation
from surrogym_trainer.policies.defaults import EXPLORATION


class Distribution(Sampled, Protocol):
    """Distribution of actions (B, F) with the derivatives that a learner needs."""

    @property
    def activation(self) -> Activation:
        """Activation of the hidden layers of actor and critic."""
        ...

    def further(self) -> Array:
        """Initial values of the parameters besides the network's, (K,)."""
        ...

    def arrays(self) -> tuple[tuple[int, ...], Array, Array]:
        """Return the numbers of choices, the centre and the reach, as compiled code expects them. Absent ones are
        empty."""
        ...

    def slopes(self, outputs: Array, further: Array, actions: Array, by: Array) -> tuple[Array, Array]:
        """Return a loss's derivatives by outputs and further parameters, given those by log probabilities, ``by``
        (B,)."""
        ...


@dataclass(frozen=True)
class Bounded(distributions.Bounded):
    """Continuous actions within bounds; their standard deviations do not depend on the state."""

    activation: Activation = "tanh"

    def further(self) -> Array:
        """Initial logarithms of the standard deviations."""
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
    """Discrete actions."""

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
    """Return the action distribution for numbers of choices, or for continuous actions within bounds (F,)."""
    if counts:
        return Choices(counts)
    return Bounded(*middle_and_reach(low, high, np.dtype(np.float32)))
