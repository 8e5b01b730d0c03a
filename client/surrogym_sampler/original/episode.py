"""Interface of a running episode in an original environment.

Shapes: C coordinates, D observation entries, F action entries.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from surrogym_sampler.original.protocol import Array
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.terms import observe


@dataclass(frozen=True)
class Moment:
    """The result of a reset or of one step of an episode."""

    observation: Array  # (D,) entries that a policy observes
    reward: float
    terminated: bool
    coordinates: Array  # (C,) state after the step
    # Whether the environment itself ended the episode before a terminal state, as by a time limit.
    truncated: bool = False
    applied: Array | None = None  # (F,) applied action, if it may differ from the requested one
    fell_back: bool = False  # whether the fallback controller's action replaced the requested one


class Episode(ABC):
    """The running episode of one instance of an environment.

    To begin the next one, call ``perturb`` if needed, then ``reset`` or ``place``, then ``step``.
    """

    parallel = False  # whether several instances may be open at once

    def __init__(self, spec: EnvironmentSpec) -> None:
        self.spec = spec

    @abstractmethod
    def reset(self, seed: int) -> Moment:
        """Begin an episode by the environment's own reset, with a seed."""

    @abstractmethod
    def place(self, coordinates: Array) -> Moment:
        """Begin an episode at coordinates (C,)."""

    @abstractmethod
    def step(self, action: Array) -> Moment:
        """Apply an action (F,), and return the result."""

    def resume(self, coordinates: Array) -> None:  # noqa: B027
        """Continue the episode at coordinates (C,) after a failed step, so that the fallback controller can act. By
        default, nothing is done, because the episode continues by itself."""

    @abstractmethod
    def perturb(self, rng: np.random.Generator, sigma: float) -> None:
        """Multiply the physical attributes by normal factors with mean 1 and standard deviation sigma."""

    @abstractmethod
    def close(self) -> None:
        """Close the environment and release its resources."""

    def _shown(self, coordinates: Array) -> Array:
        """Return the declared observation (D,) of coordinates (C,)."""
        shown: Array = observe(self.spec, coordinates[None])[0]
        return shown
