"""The interface between the sampler and an original environment: its specification and real steps.

A step starts from any state, or, if the state can't be set, follows others after a reset.

Shapes: C coordinates, F action entries, D observation entries.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Protocol, TypeGuard, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surrogym_shared.nouns import RealStep as RealStep
from surrogym_shared.spec import EnvironmentSpec

Array = NDArray[np.float64]

LONGEST_EPISODE = 1_000  # largest number of steps in an episode without a time limit


@runtime_checkable
class OriginalEnvironment(Protocol):
    """An environment that can be set to given coordinates. Any class with these three methods is one.

    With an attribute ``parallel = True``, several instances may be open at once; without it, only one.

    Examples:
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
        """Return the specification, which is known before the first query."""
        ...

    def step_from(self, coordinates: Array, action: Array) -> RealStep:
        """Set the environment to coordinates (C,), apply an action (F,), and return the real step."""
        ...

    def close(self) -> None:
        """Release the environment's resources."""
        ...


@runtime_checkable
class ResettableEnvironment(Protocol):
    """An environment that can only be reset and acted on. Any class with these five methods is one.

    ``reset`` and ``step`` are Gymnasium's, so a Gymnasium environment lacks only the other three. The specification
    must declare ``query="rollout"``.

    Examples:
        A cart that finds its own way back::

            class Cart:
                def spec(self):
                    return EnvironmentSpec.model_validate_json(Path("cart.json").read_text())

                def reset(self, *, seed=None):
                    self.rail.home()
                    return self.rail.read(), {}

                def step(self, action):
                    self.rail.push(action[0])
                    observation = self.rail.read()
                    return observation, -abs(observation[0]), False, False, {}

                def coordinates(self, observation):
                    return observation

                def close(self):
                    self.rail.park()
    """

    def spec(self) -> EnvironmentSpec:
        """Return the specification, which is known before the first query."""
        ...

    def reset(self, *, seed: int | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode, and return observation and info. An environment that can't be seeded ignores the seed."""
        ...

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Apply an action, and return observation, reward, terminated, truncated and info."""
        ...

    def coordinates(self, observation: Any) -> ArrayLike:
        """Return the coordinates that an observation shows, without those that repeat earlier values (lags)."""
        ...

    def close(self) -> None:
        """Release the environment's resources."""
        ...


@runtime_checkable
class RolloutEnvironment(Protocol):
    """An environment that answers rollout queries, sequences of actions from a reset. ``FromReset`` makes it from a
    ``ResettableEnvironment``."""

    def spec(self) -> EnvironmentSpec:
        """Return the specification, which is known before the first query."""
        ...

    def begin(self, seed: int | None = None) -> Array:
        """Reset the environment, and return the start coordinates (C,)."""
        ...

    def act(self, action: Array) -> RealStep:
        """Apply an action (F,) in the current state, and return the real step."""
        ...

    def close(self) -> None:
        """Release the environment's resources."""
        ...


@runtime_checkable
class SnapshotEnvironment(Protocol):
    """The two methods of an environment that can return to a state it was in. The specification must declare
    ``snapshots=True``.

    Examples:
        A simulator whose whole state is one number::

            class SavedCart(Cart):
                def save(self):
                    return struct.pack("<d", self.rail.x)

                def restore(self, snapshot):
                    (self.rail.x,) = struct.unpack("<d", snapshot)
                    return self.rail.read()
    """

    def save(self) -> bytes:
        """Return the whole state as bytes, in a form of the environment's own. The state does not change."""
        ...

    def restore(self, snapshot: bytes) -> ArrayLike:
        """Return to the state of a snapshot, in a new episode. A ``ResettableEnvironment`` returns the observation
        there, a ``RolloutEnvironment`` the coordinates (C,). Raise an error if the snapshot can't be used."""
        ...


def runs_in_parallel(environment: object) -> bool:
    """Return whether several instances of an environment may be open at once. This is the environment's attribute
    ``parallel``; without the attribute, it is False.

    Examples:
        A simulator sets the attribute; a machine leaves it out::

            class SimulatedCart(Cart):
                parallel = True
    """
    return bool(getattr(environment, "parallel", False))


def is_number(value: object) -> TypeGuard[float]:
    """Return whether a value is a finite number that a float can represent, and no bool."""
    try:
        return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:  # an integer that is too large for a float
        return False


Environment = OriginalEnvironment | RolloutEnvironment
Factory = Callable[[], Environment | ResettableEnvironment]
Native = Any  # an unwrapped Gymnasium environment, whose attributes differ from class to class
