"""An FMU with a specification. Its reward, its starts and its terminations are those that the specification declares,
because an FMU has none.

Shapes: C coordinates, F action entries.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import replace

import numpy as np

from surrogym_sampler.original.episodes import draw
from surrogym_sampler.original.errors import StepFailed, UnknownEnvironment
from surrogym_sampler.original.protocol import Array, RealStep
from surrogym_sampler.original.simulator import Simulated, Simulator
from surrogym_shared.logs.rewards import declared_reward
from surrogym_shared.spec import EnvironmentSpec
from surrogym_shared.terms import terminates


class SavingSimulator(Simulator):
    """A simulator that may have snapshots of its own. ``has_snapshots``: whether this one can make them."""

    has_snapshots: bool

    @property
    def saves(self) -> bool:
        return self.settable or self.has_snapshots

    @abstractmethod
    def snapshot(self) -> bytes:
        """The whole state, by the simulator's own calls."""

    @abstractmethod
    def go_back(self, snapshot: bytes) -> None:
        """Return to a state that ``snapshot`` gave."""


class FmuEnvironment(Simulated):
    """An FMU as an original environment. One instance at a time, because each one is a process."""

    parallel = False

    def __init__(self, simulator: SavingSimulator, spec: EnvironmentSpec) -> None:
        if spec.reward.kind != "declared":
            raise UnknownEnvironment(
                f"expected a declared reward for {spec.environment or 'an FMU'}, which has none of its own, got a "
                f"{spec.reward.kind} one: surrogym describe writes a specification; declare its reward there "
                "(docs/how-to/fmus.md)"
            )
        if spec.action.kind != "box" or spec.action.size != simulator.action.size:
            raise UnknownEnvironment(
                f"expected a continuous action of {simulator.action.size} entries, one for each driven input of the "
                f"FMU, got a {spec.action.kind} one of {spec.action.size}"
            )
        super().__init__(simulator, spec)
        self._saving = simulator

    def begin(self, seed: int | None = None) -> Array:
        """Start where the specification says, if the state can be set, and at the FMU's own start otherwise; the
        coordinates (C,) there."""
        if self._spec.query == "rollout":
            return super().begin(seed)
        self.place(draw(self._spec, np.random.default_rng(seed), wide=False))
        return self.coordinates()

    def act(self, action: Array) -> RealStep:
        """Apply action (F,) where the FMU stands. The reward is the declared one."""
        step = super().act(action)
        before, taken, after = (
            np.atleast_2d(np.asarray(x)) for x in (step.coordinates, step.action, step.next_coordinates)
        )
        ended = terminates(self._spec, after)
        paid = declared_reward(self._spec, before, taken, after, ended)
        return replace(step, reward=float(paid[0]), terminated=bool(ended[0]))

    def save(self) -> bytes:
        """The FMU's own state; without one, the state that can be set."""
        if self._saving.has_snapshots:
            return self._saving.snapshot()
        if not self._saving.settable:
            raise StepFailed("expected an FMU that can save its state or be set to one, got one that can only be reset")
        return super().save()

    def restore(self, snapshot: bytes) -> Array:
        """Return to a saved state; its coordinates (C,)."""
        if not self._saving.has_snapshots:
            return super().restore(snapshot)
        self._saving.go_back(snapshot)
        return self.coordinates()
