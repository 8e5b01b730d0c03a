"""The distributions of ``surrogym_shared.distributions`` as they are learned: first parameters, and derivatives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from surrogym_client.policies.defaults import EXPLORATION
from surrogym_shared import distributions
from surrogym_shared.distributions import Array, Sampled, log_softmax, middle_and_reach
from surrogym_shared.network import Activation


class Distribution(Sampled, Protocol):
    """A distribution of actions (B, F) that a learner can improve."""

    @property
    def activation(self) -> Activation:
        """Of an actor's hidden layers, and a critic's."""
        ...

    def further(self) -> Array:
        """The further parameters at first, (K,)."""
        ...

    def arrays(self) -> tuple[tuple[int, ...], Array, Array]:
        """Counts of choices, centre and reach, as compiled code takes them; what there is none of is empty."""
        ...

    def slopes(self, outputs: Array, further: Array, actions: Array, by: Array) -> tuple[Array, Array]:
        """Derivatives of a loss by outputs and further parameters, from ``by`` (B,), those by log probabilities."""
        ...


@dataclass(frozen=True)
class Bounded(distributions.Bounded):
    """Continuous, with deviations that no state changes."""

    activation: Activation = "tanh"

    def further(self) -> Array:
        """Logarithms of the deviations."""
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
    """Discrete."""

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
    """The distribution of actions with these choices, or within these bounds (F,)."""
    if counts:
        return Choices(counts)
    return Bounded(*middle_and_reach(low, high, np.dtype(np.float32)))
