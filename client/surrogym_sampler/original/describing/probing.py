"""Tests of a simulator by repeated steps: whether its state can be set exactly, and which shifts of a variable change
nothing.

Shapes: V variables of the state.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from surrogym_sampler.original.describing.counting import Counted
from surrogym_sampler.original.describing.exploring import RESETS, Seen, moved_by
from surrogym_sampler.original.errors import StepFailed
from surrogym_sampler.original.protocol import Array
from surrogym_sampler.original.simulator import Taken

PLACES = 4  # number of states, out of those that random steps reached, at which a property of a simulator is tested
EXACT = 1e-6  # a difference below this share of a variable's observed range counts as rounding
# Setting a state works if a step from the set state differs from the step that an episode took in this state by at most
# this share of each variable's observed range.
SETTABLE = 1e-3
# Two steps count as equal if they differ by at most this multiple of the noise that repeated steps have shown.
FEW = 3.0
FARTHEST = 3.0  # largest distance by which a test shifts a position, in the simulator's unit
TURN = 2 * np.pi
PART = 1.0  # shift in radians, less than a turn, that must change something if a variable is an angle
# Number of random states within the limits of the variables; a step from each tests whether states stay inside.
ANYWHERE = 32


@dataclass(frozen=True)
class Probed:
    """Results of repeated steps. Each error is the largest difference over all variables, as a share of the variable's
    observed range.

    Attributes:
        set_error: difference between a step of an episode and the same step after its state was set.
        repeat_error: difference between two steps from the same state.
        replay_error: difference between two episodes with the same seed and actions.
        shifts: names of the positions to which any distance can be added without an effect.
        turns: names of the angles to which a full turn (2 pi) can be added without an effect.
        leaving: share of the steps from random states within declared limits that lead outside by more than the width
            of the limits; 0 if this was not tested.
    """

    set_error: float
    repeat_error: float
    replay_error: float
    shifts: frozenset[str] = frozenset()
    turns: frozenset[str] = frozenset()
    leaving: float = 0.0

    @property
    def stays(self) -> bool:
        """Whether no step from within the declared limits led far outside of them."""
        return self.leaving == 0

    @property
    def noisy(self) -> bool:
        """Whether the environment is random: even episodes with the same seed and actions differ."""
        return self.replay_error > EXACT

    @property
    def settable(self) -> bool:
        """Whether setting the state restores the environment completely. It does not if a step after setting the state
        differs from the original step by more than the environment's randomness explains; the environment then has
        hidden state."""
        noise = FEW * max(self.replay_error, self.repeat_error) if self.noisy else 0.0
        return self.set_error <= max(SETTABLE, noise)


def probe(counted: Counted, seen: Seen, rng: np.random.Generator) -> Probed:
    """Repeat some explored steps, and shift variables, to test how the simulator's state can be set.

    Args:
        counted: the simulator, whose state can be set.
        seen: the explored steps.
        rng: draws states and shifts.
    """
    simulator, scale = counted.simulator, _scale(seen)
    at = np.unique(np.linspace(0, len(seen.states) - 1, PLACES + 1).astype(int)[1:])
    taken = [(seen.states[i], seen.actions[i], seen.next_states[i], float(seen.rewards[i])) for i in at]
    first = [counted.step_from(state, action) for state, action, _, _ in taken]
    again = [counted.step_from(state, action) for state, action, _, _ in taken]
    set_error = max(
        _error(reached, wanted, scale, got.reward, reward)
        for (reached, got), (_, _, wanted, reward) in zip(first, taken, strict=True)
    )
    repeat_error = max(
        _error(a, b, scale, one.reward, other.reward) for (a, one), (b, other) in zip(first, again, strict=True)
    )
    replay_error = _replayed(counted, seen, scale)
    probed = Probed(set_error, repeat_error, replay_error)
    if not probed.settable:
        return probed
    places = [(state, action, *got) for (state, action, _, _), got in zip(taken, first, strict=True)]
    shifted = _Shifted(counted, places, scale, max(EXACT, FEW * repeat_error))
    shifts, turns = set(), set()
    for i, variable in enumerate(simulator.variables):
        if variable.limited or not moved_by(seen.next_states[:, i]):
            continue
        if variable.motion == "slide" and shifted.changes_nothing(i, float(rng.uniform(1, FARTHEST))):
            shifts.add(variable.name)
        if (variable.motion == "turn" and shifted.turns(i)) or (variable.motion == "other" and shifted.is_angle(i)):
            turns.add(variable.name)
    leaving = _leaving(counted, seen, rng)
    return Probed(set_error, repeat_error, replay_error, frozenset(shifts), frozenset(turns), leaving)


class _Alike(NamedTuple):
    """Whether the results of a step stay the same if one variable is shifted before the step.

    Attributes:
        itself: whether the variable's own next value is shifted by the same amount, apart from full turns (2 pi).
        others: whether the other variables, the reward and the termination stay the same.
        shown: whether the observation stays the same.
    """

    itself: bool
    others: bool
    shown: bool


class _Shifted:
    """Steps from some states with one variable shifted, compared with the same steps without the shift.

    Args:
        counted: the simulator.
        places: for each step its state of V variables (V,), action (F,), next state (V,) and results.
        scale: observed ranges (V + 1,) of the variables and of the reward.
        same: largest difference at which two results count as equal, as a share of ``scale``.
    """

    def __init__(
        self, counted: Counted, places: Sequence[tuple[Array, Array, Array, Taken]], scale: Array, same: float
    ) -> None:
        self._counted, self._places, self._scale, self._same = counted, places, scale, same

    def changes_nothing(self, index: int, shift: float) -> bool:
        """Return whether a shift of the variable ``index`` changes neither the motion nor the observation."""
        return all(all(alike) for alike in self._compared(index, shift))

    def turns(self, index: int) -> bool:
        """Return whether adding a full turn (2 pi) to the variable ``index`` changes nothing about the motion."""
        return all(alike.itself and alike.others for alike in self._compared(index, TURN))

    def is_angle(self, index: int) -> bool:
        """Return whether the variable ``index``, whose kind of motion is unknown, is an angle: adding full turns (2 pi)
        changes nothing, but adding a part of a turn changes something.

        The second test is needed because a position on which nothing depends would pass the first. It compares only the
        other variables, the reward and the observation. The variable's own next value may lose the shift, as that of a
        remembered action does.
        """
        whole = []
        for shift in (TURN, -2 * TURN):
            for alike in self._compared(index, shift):
                if not (alike.itself and alike.others):
                    # One difference shows that the variable is no angle, so the remaining steps are left out.
                    return False
                whole.append(alike.shown)
        part = list(self._compared(index, PART))
        return not all(alike.others for alike in part) or (all(whole) and not all(alike.shown for alike in part))

    def _compared(self, index: int, shift: float) -> Iterator[_Alike]:
        """Yield the comparison of the shifted step with the original one, for each state."""
        for state, action, reached, got in self._places:
            moved = state.copy()
            moved[index] += shift
            try:
                there, step = self._counted.step_from(moved, action)
            except StepFailed:
                yield _Alike(itself=False, others=False, shown=False)
                continue
            wrong = there[index] - shift - reached[index]
            # The simulator may wrap the angle, so compare modulo one turn.
            wrong -= TURN * np.round(wrong / TURN)
            there[index] = reached[index]
            others = _error(there, reached, self._scale, step.reward, got.reward) <= self._same
            yield _Alike(
                itself=abs(wrong) / self._scale[index] <= self._same,
                others=others and step.terminated == got.terminated,
                shown=np.allclose(step.observation, got.observation, atol=1e-6),
            )


def _leaving(counted: Counted, seen: Seen, rng: np.random.Generator) -> float:
    """Return the share of steps from random states within declared limits that lead far outside of them.

    Every second state is a corner of the limits, because a state that runs away most likely does so at an extreme. If
    the simulator has mechanical variables, no step is taken and 0 is returned: limits are then the stops of joints.
    """
    simulator = counted.simulator
    limited = [i for i, v in enumerate(simulator.variables) if v.motion == "other" and v.limited]
    mechanical = any(v.mechanical for v in simulator.variables)
    if mechanical or not limited:
        return 0.0
    low, high = np.array([(simulator.variables[i].low, simulator.variables[i].high) for i in limited], float).T
    outside = 0
    for number in range(ANYWHERE):
        state, share = seen.states[rng.integers(len(seen.states))].copy(), rng.random(len(limited))
        state[limited] = low + (high - low) * (np.round(share) if number % 2 else share)
        try:
            reached, _ = counted.step_from(state, seen.actions[rng.integers(len(seen.actions))])
        except StepFailed:
            reached = np.full(len(state), np.inf)
        inside = (reached[limited] >= 2 * low - high) & (reached[limited] <= 2 * high - low)
        outside += not inside.all()
    return outside / ANYWHERE


def _replayed(counted: Counted, seen: Seen, scale: Array) -> float:
    """Repeat the first episode with its seed and actions, and return the largest difference of its first
    steps from the first time, as a share of ``scale``."""
    counted.reset(RESETS)
    rows = np.flatnonzero(seen.episodes == 0)[:PLACES]
    errors = []
    for i in rows:
        taken = counted.step(seen.actions[i])
        reached = counted.read()
        errors.append(_error(reached, seen.next_states[i], scale, taken.reward, float(seen.rewards[i])))
    return max(errors)


def _scale(seen: Seen) -> Array:
    """Return the observed ranges (V + 1,): those of the V variables and, as the last entry, that of the reward."""
    moved = np.append(moved_by(np.concatenate([seen.states, seen.next_states])), np.ptp(seen.rewards))
    return np.where(moved > 0, moved, 1.0)


def _error(reached: Array, wanted: Array, scale: Array, reward: float, wanted_reward: float) -> float:
    return float((np.abs(np.append(reached - wanted, reward - wanted_reward)) / scale).max())
