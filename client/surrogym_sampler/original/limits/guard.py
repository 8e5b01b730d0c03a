"""The guard: whether the requested action or the fallback is applied, and the watchdog for actions that do not come.

Shapes: C coordinates, F action entries.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from surrogym_sampler.original.errors import RAISED, StepFailed
from surrogym_shared.limits import fallback_action, falls_back
from surrogym_shared.spec import EnvironmentSpec

Array = NDArray[np.float64]

MOST_STEPS = 200  # largest number of steps of the fallback, which then ends even if the machine still moves
STILL = 1e-3  # a machine rests if no coordinate changes by more than this share of its largest change in the episode


class Guard:
    """Chooses the action of each step of an episode: the requested one or, shortly before a limit would be left, that
    of the specification's fallback controller.

    The choice needs no model and no network, only the last two states. Call ``begin`` at each start, ``choose`` before
    each step, and ``reached`` after it.
    """

    def __init__(self, spec: EnvironmentSpec) -> None:
        self._spec = spec
        self._before = self._at = np.zeros(len(spec.coordinates))
        self._fastest = np.zeros(len(spec.coordinates))  # (C,) largest change of a step in this episode

    def begin(self, coordinates: Array) -> None:
        """Start an episode at coordinates (C,)."""
        self._before = self._at = np.asarray(coordinates, dtype=np.float64)
        self._fastest = np.zeros(len(self._at))

    def reached(self, coordinates: Array) -> None:
        """Note that a step led to coordinates (C,)."""
        self._before, self._at = self._at, np.asarray(coordinates, dtype=np.float64)
        self._fastest = np.maximum(self._fastest, np.abs(self._at - self._before))

    def choose(self, action: Array) -> tuple[Array, bool]:
        """Return the action (F,) to apply, and whether it is the fallback controller's instead of the requested one."""
        if bool(falls_back(self._spec, self._before[None], self._at[None])[0]):
            return self.fallback(), True
        return action, False

    def fallback(self) -> Array:
        """Return the action (F,) of the specification's fallback controller in the present state."""
        return fallback_action(self._spec, self._at)

    @property
    def at_rest(self) -> bool:
        """Whether the last step hardly moved any coordinate."""
        return bool((np.abs(self._at - self._before) <= STILL * self._fastest).all())


class Watchdog:
    """Applies the specification's fallback controller until the machine rests, if no action comes for a sampling period
    during an episode.

    An episode runs from its first action on. A simulator waits for its actions, so nothing is watched there.

    The environment is used by one thread at a time: hold the watchdog (``with watchdog:``) around every call of it.

    Args:
        spec: specification with limits and a sampling period.
        guard: the guard of the running episode.
        step: applies an action (F,), reports the new state to the guard, and returns whether the episode continues.
        waits: whether the environment is a simulator that waits for its actions.
    """

    def __init__(self, spec: EnvironmentSpec, guard: Guard, step: Callable[[Array], bool], *, waits: bool) -> None:
        assert spec.sampling_period is not None
        self._period = spec.sampling_period
        self._waits = waits
        self._guard = guard
        self._step = step
        self._changed = threading.Condition(threading.RLock())
        self._deadline: float | None = None  # time at which the fallback acts; None if no action is due
        self._wanted = self._closed = False
        self._fallen = ""  # why the episode was ended by the watchdog; empty if it was not
        self._thread: threading.Thread | None = None

    def __enter__(self) -> None:
        self._wanted = True
        self._changed.acquire()
        self._wanted = False

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._changed.release()

    def check(self) -> None:
        """Raise ``StepFailed`` if the watchdog has ended the episode."""
        if self._fallen:
            raise StepFailed(self._fallen)

    def reset(self) -> None:
        """Note that the machine is at the start of an episode, at rest until its first action."""
        self._fallen, self._deadline = "", None

    def running(self) -> None:
        """Note that an action was applied. The next one is due within a sampling period."""
        if self._waits:
            return
        self._deadline = time.monotonic() + self._period
        if self._thread is None:
            self._thread = threading.Thread(target=self._watch, name="limits", daemon=True)
            self._thread.start()
        self._changed.notify_all()

    def over(self) -> None:
        """Stop waiting for an action, because no episode runs or the environment is taking a step."""
        self._deadline = None

    def fall_back(self, reason: str) -> None:
        """If the watchdog waits for an action, apply the fallback controller until the machine rests, and end the
        episode. ``reason`` is the message of the error that ``check`` then raises."""
        if self._deadline is None:
            return
        self._deadline, self._fallen = None, reason
        for _ in range(MOST_STEPS):
            if not self._step(self._guard.fallback()) or self._guard.at_rest:
                return

    def close(self, reason: str) -> None:
        """Apply the fallback controller if the watchdog waits for an action, and end the watchdog."""
        with self:
            self._closed = True
            try:
                self.fall_back(reason)
            finally:
                self._changed.notify_all()

    def _watch(self) -> None:
        with self._changed:
            while not self._closed:
                if self._deadline is None:
                    self._changed.wait()
                elif (left := self._deadline - time.monotonic()) > 0:
                    self._changed.wait(left)
                elif not self._wanted:  # otherwise the action has come, and its thread waits for this one
                    try:
                        self.fall_back(
                            f"no action came for {self._period:g} s (sampling_period), so the fallback brought the "
                            "machine to rest and the episode ended: reset it, or send actions faster"
                        )
                    except RAISED:
                        continue  # the environment raised an error, which its next call will raise again
                else:
                    self._changed.wait(self._period)
