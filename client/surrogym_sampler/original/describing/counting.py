"""A simulator whose real steps are counted, and whose errors tell the number of steps before them.

Shapes: V variables of the state, C coordinates, F action entries, D observation entries.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from surrogym_sampler.original.errors import RAISED, StepFailed, UnknownEnvironment, sentence
from surrogym_sampler.original.protocol import Array
from surrogym_sampler.original.simulator import Simulator, Taken


class Counted:
    """A simulator whose real steps and resets are counted.

    Whatever the environment raises, including ``SystemExit``, becomes ``StepFailed`` with the number of real steps
    before it. The attribute ``simulator`` is only for properties that need no call of the environment, such as the
    variables.
    """

    def __init__(self, simulator: Simulator, name: str = "the environment") -> None:
        self.simulator = simulator
        self.steps = 0
        self.resets = 0
        self.name = name

    def reset(self, seed: int) -> Array:
        """Begin an episode with a seed, and return the V variables of the state (V,)."""
        self.resets += 1
        with self._failures(self.steps):
            self.simulator.reset(seed)
            return self._read()

    def step(self, action: Array) -> Taken:
        """Take a step with an action (F,), and return its results."""
        self.steps += 1
        with self._failures(self.steps - 1):
            return self.simulator.step(action)

    def read(self) -> Array:
        """Return the V variables of the state (V,)."""
        with self._failures(self.steps):
            return self._read()

    def write(self, state: Array) -> None:
        """Set the V variables of the state (V,)."""
        with self._failures(self.steps):
            self.simulator.write(state)

    def place(self, columns: list[int], coordinates: Array) -> None:
        """Set the variables at the indices ``columns`` to coordinates (C,), and all other variables to the fixed values
        that the simulator has for them (its attribute ``rest``)."""
        with self._failures(self.steps):
            self.simulator.place(columns, coordinates)

    def observe(self) -> Array:
        """Return the observation (D,) of the current state."""
        with self._failures(self.steps):
            return self.simulator.observe()

    def touches(self) -> bool:
        """Return whether bodies touch each other in the current state."""
        with self._failures(self.steps):
            return self.simulator.touches()

    def step_from(self, state: Array, action: Array) -> tuple[Array, Taken]:
        """Set the V variables of the state (V,), and take a step. Returns the next state (V,) and the step's
        results."""
        self.write(state)
        taken = self.step(action)
        return self.read(), taken

    def close(self) -> tuple[str, ...]:
        """Close the environment. If this fails, return a sentence about the failure instead of raising an error,
        because the steps taken are still valid."""
        try:
            self.simulator.close()
        except RAISED as error:
            return (f"{self.name} could not be closed: {sentence(error)}",)
        return ()

    def _read(self) -> Array:
        state, expected = self.simulator.read(), len(self.simulator.variables)
        if len(state) != expected:
            raise StepFailed(
                f"expected the state to have {expected} numbers, as after the first reset, got {len(state)}: let "
                "the environment always have a state of the same size"
            )
        return state

    @contextmanager
    def _failures(self, steps: int) -> Iterator[None]:
        try:
            yield
        except UnknownEnvironment:
            raise
        except RAISED as error:
            raise StepFailed(
                f"the environment {self.name} failed after {steps} real steps: {sentence(error)}"
            ) from error
