"""The guard, which applies the requested action or the fallback controller's, and the watchdog for missing actions.

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
from surrogym_sampler.original.limits.programs import Program, called
from surrogym_shared.limits import fallback_action, is_near, margins, room
from surrogym_shared.spec import EnvironmentSpec

Array = NDArray[np.float64]

MOST_STEPS = 200  # after this number of steps, the fallback controller stops, even if the machine still moves
MOST_ERRORS = 5  # after this number of errors of the environment in a row, the fallback controller stops
STILL = 1e-3  # a machine rests if no coordinate changes by more than this share of its largest change in the episode


def rest_seconds(spec: EnvironmentSpec) -> float:
    """Return the longest time in seconds for which a specification's fallback controller acts, without the duration of
    its last step; 0 without limits."""
    return 0.0 if spec.limits is None else MOST_STEPS * (spec.sampling_period or 0.0)


class Guard:
    """Chooses the action of each step of an episode: the requested one or, shortly before a limit would be left, that
    of the specification's fallback controller.

    The choice needs no model and no network, only the last two states. Call ``begin`` at each start, ``choose`` before
    each step, and ``reached`` after it. A coordinate that is not finite was not measured: it keeps its last
    value, and the fallback acts until all are measured again.
    """

    def __init__(self, spec: EnvironmentSpec, program: Program | None = None) -> None:
        self._spec = spec
        self._program = program  # program of a named fallback; None if terms of the state give its action
        self._at = np.zeros(len(spec.coordinates))
        self._change = np.zeros(len(spec.coordinates))  # (C,) absolute change of each coordinate in the last step
        self._margins = margins(spec)
        # Distances (L,) to the L limits in the last state, and in the state before it.
        self._room = self._room_before = np.full(len(self._margins), np.inf)
        self._fastest = np.zeros(len(spec.coordinates))  # (C,) largest change of each coordinate in a step
        self._measured = True  # whether all coordinates of the last state are finite

    def begin(self, coordinates: Array) -> None:
        """Start an episode at coordinates (C,)."""
        self._at = self._read(coordinates)
        self._change = np.zeros(len(self._at))
        self._room = self._room_before = room(self._spec, self._at[None])[0]
        self._fastest = np.zeros(len(self._at))

    def reached(self, coordinates: Array) -> None:
        """Note that a step led to coordinates (C,)."""
        before, self._at = self._at, self._read(coordinates)
        self._change = np.abs(self._at - before)
        self._room_before, self._room = self._room, room(self._spec, self._at[None])[0]
        self._fastest = np.maximum(self._fastest, self._change)

    def choose(self, action: Array) -> tuple[Array, bool]:
        """Return the action (F,) to apply, and whether it is the fallback controller's instead of the requested one."""
        if not self._measured or bool(is_near(self._margins, self._room, self._room_before)):
            return self.fallback(), True
        return action, False

    def fallback(self) -> Array:
        """Return the action (F,) of the specification's fallback controller in the present state."""
        if self._program is None:
            return fallback_action(self._spec, self._at)
        return called(self._program, self._spec, self._at)

    @property
    def at(self) -> Array:
        """The present coordinates (C,), as far as they were measured."""
        return self._at

    @property
    def at_rest(self) -> bool:
        """Whether the last step hardly moved any coordinate, as far as they were measured."""
        return self._measured and bool((self._change <= STILL * self._fastest).all())

    def _read(self, coordinates: Array) -> Array:
        read = np.asarray(coordinates, dtype=np.float64)
        finite = np.isfinite(read)
        self._measured = bool(finite.all())
        return np.where(finite, read, self._at)


class Watchdog:
    """Applies the specification's fallback controller until the machine rests, if no action comes for a sampling period
    during an episode.

    An episode runs from its first action on. A simulator waits for its actions, so it needs no watchdog.

    Only one thread at a time may use the environment: hold the watchdog (``with watchdog:``) around every call of the
    environment. Other threads may call it between two steps of the fallback, so that a reset need not wait.

    Args:
        spec: specification with limits and a sampling period.
        guard: the guard of the running episode.
        step: applies an action (F,), reports the new state to the guard, and returns whether the episode continues.
        waits: whether the environment is a simulator that waits for its actions.
    """

    def __init__(self, spec: EnvironmentSpec, guard: Guard, step: Callable[[Array], bool], *, waits: bool) -> None:
        assert spec.sampling_period is not None
        self._spec, self._period = spec, spec.sampling_period
        self._waits = waits
        self._guard = guard
        self._step = step
        self._changed = threading.Condition(threading.RLock())
        # Time at which the fallback controller acts next, unless an action comes before; None if no episode runs.
        self._due: float | None = None
        self._wanted = self._closed = False
        self._fallen = ""  # why the watchdog ended the episode; empty if it did not
        # Number of steps of the fallback controller in this episode, and of its latest steps in a row that raised an
        # error.
        self._steps = self._errors = 0
        # Number of the fallback controller's steps in all episodes; steps that raised an error are not counted.
        self.taken = 0
        self._end = 0.0  # time at which the fallback controller stops, even if the machine still moves
        self._thread: threading.Thread | None = None

    def __enter__(self) -> None:
        self._wanted = True
        self._changed.acquire()
        self._wanted = False

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._changed.notify_all()
        self._changed.release()

    @property
    def rest_seconds(self) -> float:
        """Longest time in seconds for which the fallback controller acts, without the duration of its last step."""
        return 0.0 if self._waits else rest_seconds(self._spec)

    def check(self) -> None:
        """Raise ``StepFailed`` if the watchdog has ended the episode."""
        if self._fallen:
            raise StepFailed(self._fallen)

    def reset(self) -> None:
        """Note that the machine is at the start of an episode, at rest until its first action."""
        self._fallen, self._due = "", None

    def running(self) -> None:
        """Note that an action is applied, so that the next action is due within a sampling period. Call this before
        and after the step, because the machine may move although the step raises an error."""
        if self._waits:
            return
        self._due = time.monotonic() + self._period
        if self._thread is None:
            self._thread = threading.Thread(target=self._watch, name="limits", daemon=True)
            self._thread.start()

    def over(self) -> None:
        """Stop waiting for an action, because no episode runs."""
        self._due = None

    def close(self, reason: str) -> None:
        """Apply the fallback until the machine rests, if an episode runs, and end the watchdog."""
        with self:
            self._closed = True
            if self._due is None:
                return
            self._fall(reason)
            while self._due is not None:
                time.sleep(max(0.0, self._due - time.monotonic()))
                self._fall(reason)

    def _watch(self) -> None:
        reason = (
            f"no action came for {self._period:g} s (sampling_period), so the fallback brought the machine to rest and "
            "the episode ended: reset it, or send actions faster"
        )
        with self._changed:
            while not self._closed:
                if self._due is None:
                    self._changed.wait()
                elif (left := self._due - time.monotonic()) > 0:
                    self._changed.wait(left)
                elif self._wanted:  # another thread is about to call the environment, so the fallback waits for it
                    self._changed.wait(self._period)
                else:
                    self._fall(reason)

    def _fall(self, reason: str) -> None:
        """End the episode, take a step with the fallback controller's action, and note when its next step is due.

        After an error of the environment, the controller tries again one sampling period later.
        """
        if not self._fallen:
            self._fallen, self._steps, self._errors = reason, 0, 0
            self._end = time.monotonic() + self.rest_seconds
        self._steps += 1
        self._due = time.monotonic()
        try:
            moves = self._step(self._guard.fallback()) and not self._guard.at_rest
            self._errors = 0
            self.taken += 1
        except RAISED:
            self._errors += 1
            self._due += self._period
            moves = self._errors < MOST_ERRORS
        if not moves or self._steps >= MOST_STEPS or time.monotonic() >= self._end:
            self._due = None
