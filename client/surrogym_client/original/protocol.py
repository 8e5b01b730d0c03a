"""What the sampler needs of an original environment: its specification, and one real step from anywhere.

Shapes: C coordinates, F action entries, D observation entries.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surrogym_shared.spec import EnvironmentSpec

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RealStep:
    """One real step. ``coordinates`` and ``action`` are what was achieved, not what was asked for."""

    coordinates: ArrayLike  # (C,)
    action: ArrayLike  # (F,)
    next_coordinates: ArrayLike  # (C,)
    reward: float
    terminated: bool = False
    truncated: bool = False
    observation: ArrayLike | None = None  # (D,)
    next_observation: ArrayLike | None = None  # (D,)


@runtime_checkable
class OriginalEnvironment(Protocol):
    """An environment that can be set to given coordinates. Any class with these three methods will do.

    Example:
        A cart on a rail that is pushed::

            class Cart:
                def spec(self):
                    return EnvironmentSpec.model_validate_json(Path("cart.json").read_text())

                def step_from(self, coordinates, action):
                    self.rail.move_to(*coordinates)
                    self.rail.push(action[0])
                    achieved = self.rail.read()
                    return RealStep(coordinates, action, achieved, reward=-abs(achieved[0]))

                def close(self):
                    self.rail.park()
    """

    def spec(self) -> EnvironmentSpec:
        """What is known of the environment before the first query."""
        ...

    def step_from(self, coordinates: Array, action: Array) -> RealStep:
        """Set the environment to coordinates (C,), apply action (F,), and report what happened."""
        ...

    def close(self) -> None:
        """Release what the environment holds."""
        ...


Factory = Callable[[], OriginalEnvironment]
Native = Any  # an unwrapped Gymnasium environment, whose attributes differ from class to class
