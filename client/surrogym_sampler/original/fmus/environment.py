"""An FMU as an original environment. An FMU has no reward, starts and terminations, so the specification declares them.

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
    """A simulator that may be able to make snapshots itself; ``has_snapshots`` says whether it can."""

    has_snapshots: bool

    @property
    def saves(self) -> bool:
        return self.settable or self.has_snapshots

    @abstractmethod
    def snapshot(self) -> bytes:
        """Return the whole state, saved by the simulator itself."""

    @abstractmethod
    def go_back(self, snapshot: bytes) -> None:
        """Return to the state in a snapshot that ``snapshot`` made."""


class FmuEnvironment(Simulated):
    """An FMU as an original environment, with one instance at a time, because each is a process."""

    parallel = False

    def __init__(self, simulator: SavingSimulator, spec: EnvironmentSpec) -> None:
        if spec.reward.kind != "declared":
            raise UnknownEnvironment(
                f"expected a declared reward for {spec.environment or 'an FMU'}, which has no reward of its own, got a "
                f"{spec.reward.kind} reward: declare it in the specification that surrogym describe writes "
                "(docs/how-to/fmus.md)"
            )
        if spec.action.kind != "box" or spec.action.size != simulator.action.size:
            raise UnknownEnvironment(
                f"expected a continuous action of {simulator.action.size} entries, one for each input of the FMU that "
                f"an action sets, got a {spec.action.kind} action of {spec.action.size}: correct the specification's "
                "action"
            )
        super().__init__(simulator, spec)
        self._saving = simulator

    def begin(self, seed: int | None = None) -> Array:
        """Begin an episode: at a declared start if the state can be set, else at the FMU's own start values. Returns
        the coordinates (C,)."""
        if self._spec.query == "rollout":
            return super().begin(seed)
        self.place(draw(self._spec, np.random.default_rng(seed), wide=False))
        return self.coordinates()

    def act(self, action: Array) -> RealStep:
        """Apply an action (F,) in the current state. Reward and termination are computed as declared."""
        step = super().act(action)
        before, taken, after = (
            np.atleast_2d(np.asarray(x)) for x in (step.coordinates, step.action, step.next_coordinates)
        )
        ended = terminates(self._spec, after)
        paid = declared_reward(self._spec, before, taken, after, ended)
        return replace(step, reward=float(paid[0]), terminated=bool(ended[0]))

    def save(self) -> bytes:
        """Return a snapshot: the FMU's own saved state if it can save one, else the coordinates that can be set."""
        if self._saving.has_snapshots:
            return self._saving.snapshot()
        if not self._saving.settable:
            raise StepFailed(
                "expected an FMU that can save its state or be set to a state, got an FMU that can only be reset: "
                "register it with --access reset"
            )
        return super().save()

    def restore(self, snapshot: bytes) -> Array:
        """Return to the state in a snapshot, and return its coordinates (C,)."""
        if not self._saving.has_snapshots:
            return super().restore(snapshot)
        self._saving.go_back(snapshot)
        return self.coordinates()
