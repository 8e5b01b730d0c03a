"""Checks of an environment before it is used. States are set and read back, steps and resets are repeated, and a step
from a set state is compared with the same step of an episode. Every real step is counted.

Shapes: C coordinates, F action entries.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from surrogym_sampler.original.actions import random_action
from surrogym_sampler.original.episodes import draw
from surrogym_sampler.original.errors import StepFailed
from surrogym_sampler.original.executables import Executable
from surrogym_sampler.original.isolated import IsolatedEnvironment
from surrogym_sampler.original.protocol import Array, OriginalEnvironment, RealStep
from surrogym_sampler.original.simulator import Simulated
from surrogym_shared.spec import EnvironmentSpec, limits

PLACES = 3  # number of states to which the environment is set in a test, and of steps in a test episode
EXACT = 1e-6  # a difference below this share of a coordinate's sampling range counts as rounding
CLOSE = 1e-2  # a state counts as set if it is read back with an error of at most this share of a coordinate's range
# Two steps count as equal if they differ by at most this multiple of the noise that a few repeated steps have shown.
FEW = 3.0


class CheckFailed(StepFailed):
    """The environment failed during the checks; ``steps`` counts the real steps taken by then."""

    def __init__(self, message: str, steps: int) -> None:
        super().__init__(message)
        self.steps = steps
        self._arguments = (message, steps)

    def __reduce__(self) -> tuple[type[CheckFailed], tuple[str, int]]:
        return type(self), self._arguments


@dataclass(frozen=True)
class Access:
    """Results of repeated steps and resets.

    Each error is the largest difference that was found, as a share of a coordinate's sampling range; differences of
    rewards are relative. It is None if the comparison was not made, for example because the environment lacks a method
    that it needs.

    Attributes:
        steps: number of real steps.
        resets: number of resets.
        set_error: difference between the coordinates that were requested and those that were read back.
        repeat_error: difference between two steps from the same state with the same action.
        reset_error: difference between the starts of two resets with the same seed.
        replay_error: difference between two episodes with the same seed and actions.
        memory_error: difference between a step of an episode and the same step after its state was set.
        restore_error: difference between a step from a saved state and the same step after the state was restored.
    """

    steps: int
    resets: int
    set_error: float | None = None
    repeat_error: float | None = None
    reset_error: float | None = None
    replay_error: float | None = None
    memory_error: float | None = None
    restore_error: float | None = None

    @property
    def ignores_seed(self) -> bool:
        """Whether two resets with one seed began in different states."""
        return self.reset_error is not None and self.reset_error > EXACT

    @property
    def noise(self) -> float:
        """The larger one of ``repeat_error`` and ``replay_error``, the differences between steps that should be equal;
        0 if neither was measured."""
        return max(self.repeat_error or 0.0, self.replay_error or 0.0)

    @property
    def can_set(self) -> bool:
        """Whether the environment can be set to a state completely: the state is read back as requested, and a step
        from it gives the same result as the step that an episode took from this state."""
        if self.set_error is None or self.set_error > CLOSE:
            return False
        return self.memory_error is None or self.memory_error <= self._allowed

    @property
    def can_restore(self) -> bool:
        """Whether the environment can return to a saved state."""
        return self.restore_error is not None and self.restore_error <= self._allowed

    @property
    def _allowed(self) -> float:
        """The largest difference at which two steps from the same state count as equal: ``CLOSE``, or a multiple of the
        measured noise if the environment is random and the multiple is larger."""
        random = self.replay_error is None or self.replay_error > EXACT
        return max(CLOSE, FEW * self.noise) if random else CLOSE

    @property
    def mode(self) -> str:
        """The recommended kind of state in which queries begin (any state, a snapshot or a reset), in words, with the
        command line option for it."""
        if self.can_set:
            return "set any state"
        return "snapshots (--access snapshot)" if self.can_restore else "reset only (--access reset)"


def examine(environment: IsolatedEnvironment | Executable | Simulated, spec: EnvironmentSpec) -> Access:
    """Set, save and restore states of the environment, and compare steps that should be equal.

    Args:
        environment: the opened original environment; at most 18 real steps are taken in it.
        spec: specification of the environment. States are set only if it declares ``query="step"``, so that queries may
            begin in any state.

    Raises:
        CheckFailed: a step failed, though the specification declares the access that it needs.
    """
    looking = _Looking(environment, spec)
    try:
        if spec.query == "step":
            looking.set_states()
        looking.begin_again()
        looking.come_back()
    except StepFailed as error:
        raise CheckFailed(str(error), looking.access().steps) from error
    return looking.access()


class _Looking:
    """The checks of one environment, with the number of its real steps and the largest error of each kind so far."""

    def __init__(self, environment: IsolatedEnvironment | Executable | Simulated, spec: EnvironmentSpec) -> None:
        self._environment, self._spec = environment, spec
        self._rng = np.random.default_rng(0)
        self._steps = self._resets = 0
        self._errors: dict[str, float] = {}

    def access(self) -> Access:
        """Return the results of the checks that were made."""
        return Access(self._steps, self._resets, **self._errors)

    def set_states(self) -> None:
        """Set random states and read them back; take the same step twice from each."""
        for _ in range(PLACES):
            q, u = draw(self._spec, self._rng, wide=True), self._action()
            first, again = self._step_from(q, u), self._step_from(q, u)
            self._note("set_error", self._apart(first.coordinates, q))
            self._note("repeat_error", self._between([first], [again]))

    def begin_again(self) -> None:
        """Run two episodes with the same seed and actions, and compare them. Then set a state from which one of their
        steps began, and repeat that step."""
        actions = [self._action() for _ in range(PLACES)]
        try:
            starts, episodes = zip(*(self._episode(actions) for _ in range(2)), strict=True)
        except StepFailed:
            if self._spec.query == "rollout":
                raise
            return  # no reset is needed, as the specification's queries set the state (query="step")
        self._note("reset_error", self._apart(starts[0], starts[1]))
        self._note("replay_error", self._between(*episodes))
        inside = [step for step in episodes[1] if self._is_inside(step)]
        if self._spec.query == "step" and inside:
            wanted = inside[-1]
            again = self._step_from(np.asarray(wanted.coordinates), np.asarray(wanted.action))
            self._note("memory_error", self._between([wanted], [again]))

    def come_back(self) -> None:
        """Save a state, take a step, continue, restore the state and repeat the step."""
        if not self._spec.snapshots and not self._can_save():
            return
        action = self._action()
        self._episode([self._action()])
        snapshot = self._environment.save()
        first = self._act(action)
        if not (first.terminated or first.truncated):
            self._act(self._action())
        try:
            back = self._environment.restore(snapshot)
        except StepFailed:
            if self._spec.snapshots:
                raise
            return  # the specification declares no snapshots, so restoring may fail
        again = self._act(action)
        self._note("restore_error", self._apart(back, first.coordinates))
        self._note("restore_error", self._between([first], [again]))

    def _can_save(self) -> bool:
        try:
            return bool(self._environment.save())
        except StepFailed:
            return False

    def _act(self, action: Array) -> RealStep:
        self._steps += 1
        return self._environment.act(action)

    def _episode(self, actions: Sequence[Array]) -> tuple[Array, list[RealStep]]:
        start = self._environment.begin(0)
        self._resets += 1
        steps: list[RealStep] = []
        for action in actions:
            steps.append(self._act(action))
            if steps[-1].terminated or steps[-1].truncated:
                break
        return start, steps

    def _step_from(self, coordinates: Array, action: Array) -> RealStep:
        self._steps += 1
        assert isinstance(self._environment, OriginalEnvironment)
        return self._environment.step_from(coordinates, action)

    def _is_inside(self, step: RealStep) -> bool:
        """Return whether a step began in a state that the specification allows to be set."""
        ends = np.array([c.settable for c in self._spec.coordinates])
        at = np.asarray(step.coordinates)
        return bool(((at >= ends[:, 0]) & (at <= ends[:, 1])).all())

    def _between(self, ones: Sequence[RealStep], others: Sequence[RealStep]) -> float:
        """Return the largest difference between two lists of steps. Differences of next states are shares of the
        sampling range; those of rewards are relative. If the lists have different lengths, it is 1."""
        if len(ones) != len(others):
            return 1.0  # one episode ended earlier than the other, so they count as entirely different
        states = [self._apart(a.next_coordinates, b.next_coordinates) for a, b in zip(ones, others, strict=True)]
        paid = [
            abs(float(a.reward) - float(b.reward)) / max(1.0, abs(float(a.reward)))
            for a, b in zip(ones, others, strict=True)
        ]
        return max([*states, *paid])

    def _apart(self, one: object, other: object) -> float:
        return apart(self._spec, one, other)

    def _note(self, which: str, error: float) -> None:
        self._errors[which] = max(self._errors.get(which, 0.0), error)

    def _action(self) -> Array:
        return random_action(self._spec, self._rng)


def apart(spec: EnvironmentSpec, one: object, other: object) -> float:
    """Return the largest difference between two states (C,), as a share of the sampling range. Angles are compared by
    the shorter way around the circle."""
    difference = np.asarray(one, dtype=np.float64) - np.asarray(other, dtype=np.float64)
    for i, coordinate in enumerate(spec.coordinates):
        if coordinate.kind == "angle":
            difference[i] = (difference[i] + np.pi) % (2 * np.pi) - np.pi
    widths = np.array([np.ptp(limits(coordinate.sampling)) for coordinate in spec.coordinates])
    return float((np.abs(difference) / widths).max())
