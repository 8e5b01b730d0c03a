"""Episodes of a simulator under random actions. Every step is counted.

Shapes: n steps, R resets, V variables of the state, F action entries, D observation entries.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from surrogym_sampler.original.describing.counting import Counted
from surrogym_sampler.original.describing.usable import require_few, require_numbers, require_variables
from surrogym_sampler.original.protocol import Array
from surrogym_shared.spec import BoxAction, DiscreteAction
from surrogym_shared.spec.actions import Action

STEPS = 400
EPISODES = 4  # that share the steps if none ends early
RESETS = 32  # for the range of starts
LONGEST_HOLD = 10  # steps in a row under one action
ROUNDING = 1e-9  # of a variable's size or of 1: what moves by less than this moves by rounding only
FEWEST_EQUAL = 3  # episodes of one length that show a limit
PLACES_TRIED = 20  # random starts, of which the ones without contacts can be taken


@dataclass(frozen=True)
class Seen:
    """Data of the explored episodes.

    Attributes:
        starts: (R, V) after resets.
        states: (n, V) before each step.
        actions: (n, F).
        next_states: (n, V).
        rewards: (n,).
        terminated: (n,).
        observations: (n, D) after each step, as the simulator showed them.
        episodes: (n,) number of the episode.
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
        """Which steps (n,) ended an episode of one step, because it began in an impossible state."""
        first = np.append(True, self.episodes[1:] != self.episodes[:-1])
        last = np.append(self.episodes[1:] != self.episodes[:-1], True)
        ended: NDArray[np.bool_] = first & last & self.terminated
        return ended


def moved_by(values: Array) -> Array:
    """The range of each column (n, ...), and 0 where it is so small that rounding explains it."""
    ranges = np.ptp(values, axis=0)
    small: Array = np.where(ranges > ROUNDING * np.maximum(1.0, np.abs(values).max(0)), ranges, 0.0)
    return small


def explore(counted: Counted, steps: int, rng: np.random.Generator) -> Seen:
    """Take random steps.

    Half of the episodes start from resets. The others start at rest from positions within limits that are far from all
    positions so far. The reason: random actions leave a state of high energy and don't return to it, so the positions
    that they did not reach are those from which something falls fastest.
    """
    simulator = counted.simulator
    require_variables(counted.name, simulator.variables)
    starts = np.stack([counted.reset(seed) for seed in range(RESETS)])
    require_numbers(counted.name, (starts,), np.zeros(0))
    require_few(counted.name, simulator.variables, moved_by(starts) > 0)
    rows: list[tuple[Array, Array, Array, float, bool, Array, int]] = []
    lengths: list[int] = []  # of the episodes that the environment ended
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
    # the end of the time is no state: nothing is to be learned from it
    return seen if limit is None else replace(seen, limit=limit, terminated=np.zeros_like(seen.terminated))


def _common_length(lengths: Sequence[int], longest: int) -> int | None:
    """Length of several random episodes that all ended after the same number of steps; None otherwise. Such episodes
    end by a counter."""
    if len(lengths) < FEWEST_EQUAL or set(lengths) != {longest} or longest == 1:
        return None
    return longest


def _far_from(counted: Counted, visited: Array, state: Array, rng: np.random.Generator) -> Array:
    """Of random positions within their limits without contacts, the one that is farthest from visited states (n, V).

    A distance is the norm of the positions' differences, each as a share of its range. If all have contacts, the state
    stays unchanged.
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
        shares = np.where(turns[at], shares - np.round(shares), shares)  # the shorter way round
        distance = float(np.sqrt((shares**2).sum(1)).min())
        if distance > farthest:
            best, farthest = counted.read(), distance
    counted.write(best)
    return counted.read()


def _actions(space: Action, number: int, count: int, rng: np.random.Generator) -> list[Array]:
    """Random actions of one episode: new at each step, held for some steps, or held at the ends of their range."""
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
    counts = [space.n] if isinstance(space, DiscreteAction) else space.nvec
    return rng.integers(0, counts).astype(np.float64)
