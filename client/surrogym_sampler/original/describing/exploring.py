"""Exploration of a simulator by episodes of random actions, whose steps are counted.

An environment which no specification can express is refused, if possible before its real steps.

Shapes: n steps, R resets, V variables of the state, F action entries, D observation entries.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from surrogym_sampler.original.describing.counting import Counted
from surrogym_sampler.original.errors import UnknownEnvironment
from surrogym_sampler.original.protocol import Array
from surrogym_sampler.original.simulator import Variable
from surrogym_shared.spec import MAX_DIMENSIONS, BoxAction
from surrogym_shared.spec.actions import Action

OWN_CLASS = "in a class of your own (docs/how-to/own-environment.md)"


def require_variables(name: str, variables: Sequence[Variable]) -> None:
    """Raise ``UnknownEnvironment`` if the state of an environment has no variables."""
    if not variables:
        raise UnknownEnvironment(
            f"{name} has no state that can be read, and its observation is empty: expected a state of 1 to "
            f"{MAX_DIMENSIONS} numbers; declare them {OWN_CLASS}"
        )


def require_few(name: str, variables: Sequence[Variable], moved: NDArray[np.bool_]) -> None:
    """Raise ``UnknownEnvironment`` if too many variables moved; ``moved`` (V,) marks those that did among the
    V variables.

    Variables that a drafted specification may leave out don't count: those that are held through an episode, and slides
    without limits.
    """
    needed = np.array([v.motion != "held" and (v.motion != "slide" or v.limited) for v in variables])
    _require_at_most(name, int((moved & needed).sum()))


def require_numbers(name: str, states: Sequence[Array], rewards: Array) -> None:
    """Raise ``UnknownEnvironment`` if states, arrays (n, V) of V variables, or rewards (n,) are infinite or NaN."""
    if not all(np.isfinite(some).all() for some in states):
        raise UnknownEnvironment(
            f"{name} reached states with infinite values or NaN: expected finite numbers; narrow the "
            "bounds of its actions, or correct the environment"
        )
    if not np.isfinite(rewards).all():
        raise UnknownEnvironment(
            f"{name} gave infinite rewards or NaN under random actions: expected finite numbers; correct its reward"
        )


def require_coordinates(name: str, count: int, steps: int) -> None:
    """Raise ``UnknownEnvironment`` if a description would have no coordinates, or too many.

    Args:
        name: the environment.
        count: number of variables that would become coordinates.
        steps: number of random steps that were taken.
    """
    if not count:
        raise UnknownEnvironment(
            f"no variable of {name} differed between resets or moved in {steps} random steps: expected at least one "
            f"that does; take more steps (--steps), or declare the coordinates {OWN_CLASS}"
        )
    _require_at_most(name, count)


def _require_at_most(name: str, count: int) -> None:
    if count > MAX_DIMENSIONS:
        raise UnknownEnvironment(
            f"{name} has {count} variables that move: expected at most {MAX_DIMENSIONS}; choose those that "
            f"the next state depends on, and declare them {OWN_CLASS}"
        )


STEPS = 400
EPISODES = 4  # number of random episodes that share the steps, if no episode ends early
RESETS = 32  # number of resets that show the range of start states
LONGEST_HOLD = 10  # largest number of steps for which a random action is held
ROUNDING = 1e-9  # a variable that varies by less than this share of its largest value (at least 1) counts as constant
FEWEST_EQUAL = 3  # if at least this number of episodes ended, all after the same number of steps, there is a time limit
PLACES_TRIED = 20  # number of random positions from which a start without contacts is chosen


@dataclass(frozen=True)
class Seen:
    """The data of the explored episodes.

    Attributes:
        starts: states after the R resets, each of V variables (R, V).
        states: states before each of the n steps (n, V).
        actions: actions (n, F).
        next_states: states after each step (n, V).
        rewards: rewards (n,).
        terminated: which steps ended their episode by a termination (n,).
        observations: observations after each step (n, D), as the simulator returned them.
        episodes: number of the episode of each step (n,).
        limit: number of steps after which every episode ended; None if they ended at different steps, or not at all.
    """

    starts: Array
    states: Array
    actions: Array
    next_states: Array
    rewards: Array
    terminated: NDArray[np.bool_]
    observations: Array
    episodes: NDArray[np.int64]
    limit: int | None = field(default=None, kw_only=True)

    @property
    def ended_at_once(self) -> NDArray[np.bool_]:
        """Mask (n,) of the steps that ended an episode at once, because the episode began in an impossible state."""
        first = np.append(True, self.episodes[1:] != self.episodes[:-1])
        last = np.append(self.episodes[1:] != self.episodes[:-1], True)
        ended: NDArray[np.bool_] = first & last & self.terminated
        return ended


def moved_by(values: Array) -> Array:
    """Return the range of each column of values (n, ...); 0 if it is so small that rounding explains it."""
    ranges = np.ptp(values, axis=0)
    small: Array = np.where(ranges > ROUNDING * np.maximum(1.0, np.abs(values).max(0)), ranges, 0.0)
    return small


def explore(counted: Counted, steps: int, rng: np.random.Generator) -> Seen:
    """Take ``steps`` real steps in random episodes, after ``RESETS`` resets.

    Half of the episodes start from resets. If the state can be set, the others start at rest from positions within the
    limits that are far from all positions so far. Random actions lead away from states of high energy, such as an
    upright pole, and don't return there. But the largest speeds occur in falls from such states, and the ranges of
    speeds have to include them.
    """
    simulator = counted.simulator
    require_variables(counted.name, simulator.variables)
    starts = np.stack([counted.reset(seed) for seed in range(RESETS)])
    require_numbers(counted.name, (starts,), np.zeros(0))
    require_few(counted.name, simulator.variables, moved_by(starts) > 0)
    rows: list[tuple[Array, Array, Array, float, bool, Array, int]] = []
    lengths: list[int] = []  # lengths of the episodes that the environment ended itself
    length, number = max(1, -(-steps // EPISODES)), 0
    while len(rows) < steps:
        state = counted.reset(RESETS + number)
        if number % 2 and simulator.settable:
            visited = np.array([row[0] for row in rows] + [rows[-1][2]])
            state = _far_from(counted, visited, state, rng)
        for action in _actions(simulator.action, number, min(length, steps - len(rows)), rng):
            taken = counted.step(action)
            reached = counted.read()
            rows.append((state, action, reached, taken.reward, taken.terminated, taken.observation, number))
            state = reached
            if taken.terminated or taken.truncated or not np.isfinite(reached).all():
                lengths.append(sum(row[-1] == number for row in rows))
                break
        number += 1
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    seen = Seen(starts, *columns)
    limit = _common_length(lengths, int(np.bincount(seen.episodes).max()))
    # A time limit ends an episode in any state, so these ends are not terminations that a model could learn.
    return seen if limit is None else replace(seen, limit=limit, terminated=np.zeros_like(seen.terminated))


def _common_length(lengths: Sequence[int], longest: int) -> int | None:
    """Return the length of the episodes if the environment ended all of them, at least three, after the same number of
    steps; None otherwise. A time limit ends episodes in this way."""
    if len(lengths) < FEWEST_EQUAL or set(lengths) != {longest} or longest == 1:
        return None
    return longest


def _far_from(counted: Counted, visited: Array, state: Array, rng: np.random.Generator) -> Array:
    """Set the simulator to a position far from the visited states, and return its state (V,).

    Of random positions within their limits and without contacts, the one farthest from all visited states is chosen. A
    distance is the norm of the positions' differences, each as a share of its range. If all positions have contacts,
    ``state`` is set again.

    Args:
        counted: the simulator.
        visited: states (n, V) of the steps so far.
        state: the state (V,) after the reset.
        rng: draws the positions.
    """
    variables = counted.simulator.variables
    turns = np.array([v.motion == "turn" and not v.limited for v in variables])
    at = [i for i, v in enumerate(variables) if v.motion == "turn" or (v.motion == "slide" and v.limited)]
    bounds = [(variables[i].low, variables[i].high) for i in at]
    low = np.array([-np.pi if lowest is None else lowest for lowest, _ in bounds])
    high = np.array([np.pi if highest is None else highest for _, highest in bounds])
    best, farthest = state, -1.0
    for _ in range(PLACES_TRIED):
        placed = state.copy()
        placed[at] = rng.uniform(low, high)
        counted.write(placed)
        if counted.touches():
            continue
        shares = (visited[:, at] - placed[at]) / np.maximum(high - low, 1e-12)
        # Angles differ by the shorter way around the circle.
        shares = np.where(turns[at], shares - np.round(shares), shares)
        distance = float(np.sqrt((shares**2).sum(1)).min())
        if distance > farthest:
            best, farthest = counted.read(), distance
    counted.write(best)
    return counted.read()


def _actions(space: Action, number: int, count: int, rng: np.random.Generator) -> list[Array]:
    """Return ``count`` random actions (F,) of one episode. The episode's number decides whether they are new at each
    step, held for some steps, or held at the ends of their range."""
    longest = (1, LONGEST_HOLD, LONGEST_HOLD, 1)[number % 4]
    actions: list[Array] = []
    while len(actions) < count:
        drawn = _drawn(space, rng, ends=number % 4 == 2)
        actions += [drawn] * int(rng.integers(1, longest + 1))
    return actions[:count]


def _drawn(space: Action, rng: np.random.Generator, *, ends: bool) -> Array:
    if isinstance(space, BoxAction):
        low, high = np.array(space.low), np.array(space.high)
        return np.where(rng.random(len(low)) < 0.5, low, high) if ends else rng.uniform(low, high)
    return rng.integers(0, space.nvec).astype(np.float64)
