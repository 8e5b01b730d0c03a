"""Action distributions: how the outputs of an actor become a bounded normal distribution, or a choice for each entry.

The methods of both are those that ``Bounded`` explains.

Shapes: B rows (observations), A outputs of the actor network, F action entries, K further parameters, which do not
depend on the state.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

HALF_LOG_TAU = 0.5 * float(np.log(2 * np.pi))

Array = NDArray[np.floating[Any]]  # array of floats of any precision; a training uses float32


@dataclass(frozen=True)
class Bounded:
    """Normal distribution of continuous actions with the mean centre + reach tanh(outputs). The further parameters are
    log standard deviations (F,)."""

    centre: Array  # (F,) middle of the range of each of F action entries
    reach: Array  # (F,) half the width of the range of each of F action entries

    @property
    def outputs(self) -> int:
        """Number of outputs of an actor, A."""
        return len(self.reach)

    def sample(self, outputs: Array, further: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        """Draw an action for each row of ``outputs`` (B, A), given the distribution's parameters ``further`` (K,).
        Return the actions (B, F), not clipped to bounds, and their log probabilities (B,)."""
        z = rng.standard_normal(outputs.shape, dtype=_kind(outputs))
        actions = self.centre + self.reach * np.tanh(outputs) + np.exp(further) * z
        return actions, (-0.5 * z * z - further - HALF_LOG_TAU).sum(1)

    def sent(self, actions: Array) -> NDArray[Any]:
        """Convert B sampled actions (B, F) to actions that a surrogate takes: clipped to bounds, or integer choices."""
        low, high = self.centre - self.reach, self.centre + self.reach
        return np.clip(actions, low, high)

    def log_probability(self, outputs: Array, further: Array, actions: Array) -> Array:
        """Return the log probabilities (B,) of B actions (B, F), given the actor's outputs (B, A) and the
        distribution's parameters ``further`` (K,)."""
        z = (actions - self.centre - self.reach * np.tanh(outputs)) * np.exp(-further)
        log: Array = (-0.5 * z * z - further - HALF_LOG_TAU).sum(1)
        return log


@dataclass(frozen=True)
class Choices:
    """Independent categorical distributions of discrete action entries. The outputs are their logits."""

    counts: tuple[int, ...]

    @property
    def outputs(self) -> int:
        return sum(self.counts)

    def sample(self, outputs: Array, further: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        # An exponential random number of 0 gives the noise inf, so that this choice is taken.
        with np.errstate(divide="ignore"):
            gumbel = -np.log(rng.standard_exponential(outputs.shape, dtype=_kind(outputs)))
        # The largest output with Gumbel noise is a random choice with the probabilities of the softmax.
        choices = [part.argmax(1) for part in self.parts(outputs + gumbel)]
        actions = np.stack(choices, 1).astype(np.float32)
        return actions, self.log_probability(outputs, further, actions)

    def sent(self, actions: Array) -> NDArray[Any]:
        choices = actions.astype(np.int64)
        return choices[:, 0] if len(self.counts) == 1 else choices

    def log_probability(self, outputs: Array, further: Array, actions: Array) -> Array:  # noqa: ARG002
        logs = [log_softmax(part) for part in self.parts(outputs)]
        rows = np.arange(len(outputs))
        log: Array = np.sum([part[rows, actions[:, i].astype(np.int64)] for i, part in enumerate(logs)], axis=0)
        return log

    def parts(self, outputs: Array) -> list[Array]:
        """Split an actor's outputs (B, A) for B observations into the logits of each action entry."""
        return np.split(outputs, np.cumsum(self.counts)[:-1], axis=1)


def distribution_of(
    counts: tuple[int, ...], low: NDArray[np.float64], high: NDArray[np.float64], dtype: np.dtype[Any]
) -> Bounded | Choices:
    """Return the distribution of discrete actions with these numbers of choices, or of continuous actions within bounds
    (F,), whose parameters have this dtype."""
    return Choices(counts) if counts else Bounded(((low + high) / 2).astype(dtype), ((high - low) / 2).astype(dtype))


def log_softmax(scores: Array) -> Array:
    shifted = scores - scores.max(1, keepdims=True)
    log: Array = shifted - np.log(np.exp(shifted).sum(1, keepdims=True))
    return log


def _kind(outputs: Array) -> type[np.float32] | type[np.float64]:
    return np.float32 if outputs.dtype == np.float32 else np.float64
