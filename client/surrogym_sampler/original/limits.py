"""Guard of an original environment with declared limits: its fallback controller acts before a limit is left, and when
no action comes.

The guard applies the requested action or the fallback controller's, and a watchdog notices missing actions. Queries and
episodes of a policy keep limits alike. A fallback that is a program is a Python function, which only a person at the
machine can give.

Shapes: C coordinates, F action entries.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from surrogym_sampler.original.episode import Episode, Moment
from surrogym_sampler.original.errors import (
    RAISED,
    FallbackFailed,
    StepFailed,
    StepRefused,
    UnknownEnvironment,
    sentence,
)
from surrogym_sampler.original.factories import load_factory
from surrogym_sampler.original.protocol import (
    Array,
    Environment,
    OriginalEnvironment,
    RealStep,
    RolloutEnvironment,
    runs_in_parallel,
)
from surrogym_shared.limits import clipped_action, fallback_action, falls_back, is_near, margins, nearest, room, starts
from surrogym_shared.spec import BoxAction, EnvironmentSpec
from surrogym_shared.spec.safety import NamedFallback
from surrogym_shared.terminal import say

Program = Callable[[Array], ArrayLike]  # an action (F,) from coordinates (C,)


def program_of(spec: EnvironmentSpec, given: str | None) -> Program | None:
    """Return the program of the fallback that the limits of a specification name; None if they name none.

    Args:
        spec: the specification.
        given: what a person gave, as NAME=package.module:function.

    Raises:
        UnknownEnvironment: no program was given for the name, one for another name, one that can't be called, or one
            that gives no action at a start of the specification.
    """
    declared = None if spec.limits is None else spec.limits.fallback
    if not isinstance(declared, NamedFallback):
        if given is not None:
            raise UnknownEnvironment(
                "--fallback: expected a specification whose limits name a program as their fallback, got "
                f"{given!r} for one that names none: leave the option out"
            )
        return None
    name, _, target = (given or "").partition("=")
    if name != declared.name or not target:
        raise UnknownEnvironment(
            f"the limits name the fallback {declared.name!r}: expected --fallback "
            f"{declared.name}=package.module:function, got {given or 'none'}"
        )
    program: Program = load_factory(target)
    try:
        called(program, spec, next(starts(spec))[0])
    except RAISED as error:  # near a limit, it would fail in the same way
        raise UnknownEnvironment(
            f"--fallback {given} was tried at a start, without a step: {sentence(error)}"
        ) from error
    return program


def called(program: Program, spec: EnvironmentSpec, coordinates: Array) -> Array:
    """Return the action (F,) that a program chooses at coordinates (C,), clipped to the action's range and, if it is
    discrete, rounded.

    Raises:
        StepFailed: the program does not return F finite numbers.
    """
    action = np.atleast_1d(np.asarray(program(coordinates.copy()), dtype=np.float64))
    if action.shape != (spec.action.size,) or not np.isfinite(action).all():
        raise StepFailed(
            f"expected {spec.action.size} finite numbers from the fallback's program, got {action.tolist()}: correct it"
        )
    return clipped_action(spec, action if isinstance(spec.action, BoxAction) else np.rint(action))


MOST_STEPS = 200  # after this number of steps, the fallback controller stops, even if the machine still moves
FAILED = "limits: the fallback failed, so the machine may still move: stop it by hand"
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
        self._given_up = False  # whether the fallback controller failed too often in a row; it stays so
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

    def __exit__(self, *_: object) -> None:
        self._changed.notify_all()
        self._changed.release()

    @property
    def rest_seconds(self) -> float:
        """Longest time in seconds for which the fallback controller acts, without the duration of its last step."""
        return 0.0 if self._waits else rest_seconds(self._spec)

    def check(self) -> None:
        """Raise ``StepFailed`` if the watchdog has ended the episode, ``FallbackFailed`` if its fallback gave up."""
        self.check_fallback()
        if self._fallen:
            raise StepFailed(self._fallen)

    def check_fallback(self) -> None:
        """Raise ``FallbackFailed`` if the fallback controller gave up, so that a person has to stop the machine."""
        if self._given_up:
            raise FallbackFailed(self._fallen)

    def begin(self, coordinates: Array) -> None:
        """Note that an episode starts at coordinates (C,), where the machine rests until its first action."""
        self._guard.begin(coordinates)
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

    def reached(self, coordinates: Array, *, ended: bool) -> None:
        """Note that a step led to coordinates (C,), and whether it ended the episode."""
        self._guard.reached(coordinates)
        if ended:
            self._due = None
        else:
            self.running()

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
        except RAISED as error:
            self._errors += 1
            self._due += self._period
            moves = self._errors < MOST_ERRORS
            if not moves:
                self._fallen, self._given_up = f"{FAILED}: {sentence(error)}", True
                say(self._fallen)
        if not moves or self._steps >= MOST_STEPS or time.monotonic() >= self._end:
            self._due = None


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
        """Number of real steps, part of no query, that the fallback controller took because no action came."""
        return self._watchdog.taken

    def begin(self, seed: int | None = None) -> Array:
        with self._watchdog:
            self._watchdog.check_fallback()
            return self._started(self._environment.begin(seed))

    def act(self, action: Array) -> RealStep:
        """Apply the action (F,), or the fallback controller's shortly before a limit would be left.

        Raises:
            StepFailed: the watchdog has ended the episode.
        """
        with self._watchdog:
            self._watchdog.check()
            self._watchdog.running()
            step: RealStep = self._environment.act(self._guard.choose(action)[0])
            at, ended = np.asarray(step.next_coordinates, dtype=np.float64), step.terminated or step.truncated
            self._watchdog.reached(at, ended=ended)
            return step

    def save(self) -> bytes:
        with self._watchdog:
            self._watchdog.check()
            snapshot: bytes = self._environment.save()
            return snapshot

    def restore(self, snapshot: bytes) -> Array:
        with self._watchdog:
            self._watchdog.check_fallback()
            return self._started(self._environment.restore(snapshot))

    def close(self) -> None:
        try:
            self._watchdog.close(ENDS)
        finally:
            self._environment.close()

    def _started(self, coordinates: Any) -> Array:
        start = np.asarray(coordinates, dtype=np.float64)
        self._watchdog.begin(start)
        return start

    def _fall(self, action: Array) -> bool:
        """Apply the fallback controller's action (F,), and return whether the episode continues."""
        if hasattr(self._environment, "resume"):
            self._environment.resume(self._guard.at)
        step: RealStep = self._environment.act(action)
        self._guard.reached(np.asarray(step.next_coordinates, dtype=np.float64))
        return not (step.terminated or step.truncated)


class GuardedEpisode(Episode):
    """An episode that keeps the limits of its specification. The declared fallback controller acts in the place of the
    policy shortly before a limit would be left, and when no action comes for a sampling period."""

    def __init__(self, episode: Episode, fallback: str | None = None) -> None:
        super().__init__(episode.spec)
        self.parallel = episode.parallel
        self._episode = episode
        self._guard = Guard(episode.spec, program_of(episode.spec, fallback))
        self._watchdog = Watchdog(episode.spec, self._guard, self._fall, waits=self.parallel)

    def reset(self, seed: int) -> Moment:
        with self._watchdog:
            self._watchdog.check_fallback()
            return self._started(self._episode.reset(seed))

    def place(self, coordinates: Array) -> Moment:
        with self._watchdog:
            self._watchdog.check_fallback()
            return self._started(self._episode.place(coordinates))

    def step(self, action: Array) -> Moment:
        """Apply the action (F,), or the fallback controller's shortly before a limit would be left. In that case,
        ``fell_back`` of the result is true and ``applied`` is the applied action.

        Raises:
            StepFailed: the watchdog has ended the episode.
        """
        with self._watchdog:
            self._watchdog.check()
            self._watchdog.running()
            chosen, fallen = self._guard.choose(action)
            moment = self._episode.step(chosen)
            self._watchdog.reached(moment.coordinates, ended=moment.terminated or moment.truncated)
            applied = chosen if moment.applied is None else moment.applied
            return replace(moment, applied=applied, fell_back=True) if fallen else moment

    def perturb(self, rng: np.random.Generator, sigma: float) -> None:
        self._episode.perturb(rng, sigma)

    def close(self) -> None:
        try:
            self._watchdog.close("the episode's environment is closed")
        finally:
            self._episode.close()

    def _started(self, moment: Moment) -> Moment:
        self._watchdog.begin(moment.coordinates)
        return moment

    def _fall(self, action: Array) -> bool:
        self._episode.resume(self._guard.at)
        moment = self._episode.step(action)
        self._guard.reached(moment.coordinates)
        return not (moment.terminated or moment.truncated)
