"""What an actor's outputs mean: a normal distribution within bounds, or a choice for each entry of an action."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from surrogym_client.policies.defaults import EXPLORATION
from surrogym_shared.network import Activation

HALF_LOG_TAU = 0.5 * float(np.log(2 * np.pi))

Array = NDArray[np.floating[Any]]  # float32 in a training


class Distribution(Protocol):
    """Of actions (B, F), by an actor's outputs (B, A) and further parameters that no network gives, (K,)."""

    @property
    def outputs(self) -> int:
        """Numbers that an actor gives, A."""
        ...

    @property
    def activation(self) -> Activation:
        """Of an actor's hidden layers, and a critic's."""
        ...

    def further(self) -> Array:
        """The further parameters at first."""
        ...

    def sample(self, outputs: Array, further: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        """Actions as they are learned from (B, F), and their log probabilities (B,)."""
        ...

    def sent(self, actions: Array) -> NDArray[Any]:
        """These actions as a surrogate takes them."""
        ...

    def log_probability(self, outputs: Array, further: Array, actions: Array) -> Array:
        """Of actions (B, F), (B,)."""
        ...

    def slopes(self, outputs: Array, further: Array, actions: Array, by: Array) -> tuple[Array, Array]:
        """Derivatives of a loss by outputs and further parameters, from ``by`` (B,), those by log probabilities."""
        ...


@dataclass(frozen=True)
class Bounded:
    """Continuous: normal around centre + reach tanh(y), with deviations that no state changes."""

    centre: Array  # (F,)
    reach: Array  # (F,)
    activation: Activation = "tanh"

    @property
    def outputs(self) -> int:
        return len(self.reach)

    def further(self) -> Array:
        """Logarithms of the deviations."""
        logarithms: Array = np.log(EXPLORATION * self.reach).astype(np.float32)
        return logarithms

    def sample(self, outputs: Array, further: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        z = rng.standard_normal(outputs.shape, dtype=np.float32)
        actions = self.centre + self.reach * np.tanh(outputs) + np.exp(further) * z
        return actions, (-0.5 * z * z - further - HALF_LOG_TAU).sum(1)

    def sent(self, actions: Array) -> NDArray[Any]:
        low, high = self.centre - self.reach, self.centre + self.reach
        return np.clip(actions, low, high)

    def log_probability(self, outputs: Array, further: Array, actions: Array) -> Array:
        z = (actions - self.centre - self.reach * np.tanh(outputs)) * np.exp(-further)
        log: Array = (-0.5 * z * z - further - HALF_LOG_TAU).sum(1)
        return log

    def slopes(self, outputs: Array, further: Array, actions: Array, by: Array) -> tuple[Array, Array]:
        bent = np.tanh(outputs)
        z = (actions - self.centre - self.reach * bent) * np.exp(-further)
        by_mean = by[:, None] * z * np.exp(-further)
        return by_mean * self.reach * (1 - bent * bent), (by[:, None] * (z * z - 1)).sum(0)


@dataclass(frozen=True)
class Choices:
    """Discrete: one choice for each entry of an action, independent of one another."""

    counts: tuple[int, ...]
    activation: Activation = "relu"

    @property
    def outputs(self) -> int:
        return sum(self.counts)

    def further(self) -> Array:
        return np.zeros(0, dtype=np.float32)

    def sample(self, outputs: Array, further: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        gumbel = -np.log(rng.standard_exponential(outputs.shape, dtype=np.float32))
        chosen = [part.argmax(1) for part in self._parts(outputs + gumbel)]  # Gumbel's maximum draws by softmax
        actions = np.stack(chosen, 1).astype(np.float32)
        return actions, self.log_probability(outputs, further, actions)

    def sent(self, actions: Array) -> NDArray[Any]:
        chosen = actions.astype(np.int64)
        return chosen[:, 0] if len(self.counts) == 1 else chosen

    def log_probability(self, outputs: Array, further: Array, actions: Array) -> Array:  # noqa: ARG002
        logs = [_log_softmax(part) for part in self._parts(outputs)]
        rows = np.arange(len(outputs))
        log: Array = np.sum([part[rows, actions[:, i].astype(np.int64)] for i, part in enumerate(logs)], axis=0)
        return log

    def slopes(self, outputs: Array, further: Array, actions: Array, by: Array) -> tuple[Array, Array]:
        slopes, rows = [], np.arange(len(outputs))
        for i, part in enumerate(self._parts(outputs)):
            slope = -np.exp(_log_softmax(part))
            slope[rows, actions[:, i].astype(np.int64)] += 1
            slopes.append(by[:, None] * slope)
        return np.concatenate(slopes, 1), np.zeros_like(further)

    def _parts(self, outputs: Array) -> list[Array]:
        return np.split(outputs, np.cumsum(self.counts)[:-1], axis=1)


def distribution_of(counts: tuple[int, ...], low: NDArray[np.float64], high: NDArray[np.float64]) -> Distribution:
    """The distribution of actions with these choices, or within these bounds (F,)."""
    if counts:
        return Choices(counts)
    return Bounded(((low + high) / 2).astype(np.float32), ((high - low) / 2).astype(np.float32))


def _log_softmax(scores: Array) -> Array:
    shifted = scores - scores.max(1, keepdims=True)
    log: Array = shifted - np.log(np.exp(shifted).sum(1, keepdims=True))
    return log
