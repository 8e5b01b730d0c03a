"""Environments whose queries keep declared limits."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from surrogym_sampler.original.errors import StepRefused
from surrogym_sampler.original.limits.guard import Guard, Watchdog
from surrogym_sampler.original.limits.programs import Program, program_of
from surrogym_sampler.original.protocol import (
    Environment,
    OriginalEnvironment,
    RealStep,
    RolloutEnvironment,
    runs_in_parallel,
)
from surrogym_shared.limits import falls_back, nearest
from surrogym_shared.spec import EnvironmentSpec

Array = NDArray[np.float64]
ENDS = "the environment is closed"


def guarded(environment: Environment, fallback: str | None = None) -> Environment:
    """Return an environment that keeps its specification's limits. ``fallback`` gives the program of a named fallback,
    as NAME=package.module:function."""
    program = program_of(environment.spec(), fallback)
    if isinstance(environment, OriginalEnvironment) and environment.spec().query == "step":
        return GuardedSteps(environment)
    assert isinstance(environment, RolloutEnvironment)
    return GuardedRollouts(environment, program)


class GuardedSteps:
    """An environment with limits that can be set to states. States beyond a limit, or within its margin, are
    refused."""

    def __init__(self, environment: OriginalEnvironment) -> None:
        self._environment, self._spec = environment, environment.spec()
        self.parallel = runs_in_parallel(environment)

    def spec(self) -> EnvironmentSpec:
        return self._spec

    def step_from(self, coordinates: Array, action: Array) -> RealStep:
        """Take a real step.

        Raises:
            StepRefused: the state lies beyond a limit, or within its margin.
        """
        at = np.asarray(coordinates, dtype=np.float64)[None]
        if bool(falls_back(self._spec, at, at)[0]):
            limit, left = nearest(self._spec, at[0])
            raise StepRefused(
                f"expected a state whose distance from the limit {limit.name!r} is at least its margin of "
                f"{limit.margin:g}, got a distance of {left:.4g}; no step was taken, and the design chooses another "
                "query"
            )
        return self._environment.step_from(coordinates, action)

    def close(self) -> None:
        self._environment.close()


class GuardedRollouts:
    """An environment with limits that is reset and acted on. Shortly before a limit would be left, the action of the
    specification's fallback controller replaces the requested one.

    If no action comes for a sampling period, or the environment is closed while an episode runs, the fallback brings
    the machine to rest, and the episode ends. Returned steps have the action that was applied.
    """

    keeps_rates = True  # the wrapped environment keeps actions within the declared rates

    def __init__(self, environment: RolloutEnvironment, program: Program | None = None) -> None:
        self._environment: Any = environment  # Any, because the methods save, restore and resume are optional
        self._spec = environment.spec()
        self.parallel = runs_in_parallel(environment)
        self._guard = Guard(self._spec, program)
        self._watchdog = Watchdog(self._spec, self._guard, self._fall, waits=self.parallel)
        self.rest_seconds = self._watchdog.rest_seconds  # longest duration of the fallback in ``close``

    def spec(self) -> EnvironmentSpec:
        return self._spec

    @property
    def fallback_steps(self) -> int:
        """Number of real steps of the watchdog's fallback, which are part of no query."""
        return self._watchdog.taken

    def begin(self, seed: int | None = None) -> Array:
        with self._watchdog:
            return self._started(self._environment.begin(seed))

    def act(self, action: Array) -> RealStep:
        """Apply the action (F,), or the fallback controller's shortly before a limit would be left.

        Raises:
            StepFailed: the watchdog has ended the episode.
        """
        with self._watchdog:
            self._watchdog.check()
            self._watchdog.running()
            return self._acted(self._guard.choose(action)[0])

    def save(self) -> bytes:
        with self._watchdog:
            self._watchdog.check()
            snapshot: bytes = self._environment.save()
            return snapshot

    def restore(self, snapshot: bytes) -> Array:
        with self._watchdog:
            return self._started(self._environment.restore(snapshot))

    def close(self) -> None:
        try:
            self._watchdog.close(ENDS)
        finally:
            self._environment.close()

    def _started(self, coordinates: Any) -> Array:
        start = np.asarray(coordinates, dtype=np.float64)
        self._guard.begin(start)
        self._watchdog.reset()
        return start

    def _acted(self, action: Array) -> RealStep:
        step: RealStep = self._environment.act(action)
        self._guard.reached(np.asarray(step.next_coordinates, dtype=np.float64))
        if step.terminated or step.truncated:
            self._watchdog.over()
        else:
            self._watchdog.running()
        return step

    def _fall(self, action: Array) -> bool:
        """Apply the fallback controller's action (F,), and return whether the episode continues."""
        if hasattr(self._environment, "resume"):
            self._environment.resume(self._guard.at)
        step: RealStep = self._environment.act(action)
        self._guard.reached(np.asarray(step.next_coordinates, dtype=np.float64))
        return not (step.terminated or step.truncated)
