"""Episodes of a simulator under random actions. Every step is counted.

Shapes: n steps, R resets, V variables of the state, F action entries, D observation entries.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surrogym_client.original.protocol import Array
from surrogym_client.original.simulator import Simulator, Taken
from surrogym_shared.spec import BoxAction, DiscreteAction
from surrogym_shared.spec.actions import Action

STEPS = 400
EPISODES = 4  # that share the steps if none ends early
RESETS = 32  # for the range of starts
LONGEST_HOLD = 10  # steps in a row under one action
PLACES_TRIED = 20  # attempts to find a start without contacts


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
    """

    starts: Array
    states: Array
    actions: Array
    next_states: Array
    rewards: Array
    terminated: NDArray[np.bool_]
    observations: Array
    episodes: NDArray[np.int64]

    @property
    def ended_at_once(self) -> NDArray[np.bool_]:
        """Which steps (n,) ended an episode of one step, because it began in an impossible state."""
        first = np.append(True, self.episodes[1:] != self.episodes[:-1])
        last = np.append(self.episodes[1:] != self.episodes[:-1], True)
        ended: NDArray[np.bool_] = first & last & self.terminated
        return ended


class Counted:
    """A simulator whose real steps and resets are counted."""

    def __init__(self, simulator: Simulator) -> None:
        self.simulator = simulator
        self.steps = 0
        self.resets = 0

    def reset(self, seed: int) -> Array:
        """Begin an episode. Returns the state (V,)."""
        self.resets += 1
        self.simulator.reset(seed)
        return self.simulator.read()

    def step(self, action: Array) -> Taken:
        """Take a step."""
        self.steps += 1
        return self.simulator.step(action)

    def step_from(self, state: Array, action: Array) -> tuple[Array, Taken]:
        """Set the state (V,) and take a step. Returns the next state and the step's results."""
        self.simulator.write(state)
        taken = self.step(action)
        return self.simulator.read(), taken


def explore(counted: Counted, steps: int, rng: np.random.Generator) -> Seen:
    """Take random steps: half of the episodes start from resets, the others from random positions within limits."""
    simulator = counted.simulator
    starts = np.stack([counted.reset(seed) for seed in range(RESETS)])
    rows: list[tuple[Array, Array, Array, float, bool, Array, int]] = []
    length, number = max(1, -(-steps // EPISODES)), 0
    while len(rows) < steps:
        state = counted.reset(RESETS + number)
        if number % 2 and simulator.settable:
            state = _anywhere(simulator, state, rng)
        for action in _actions(simulator.action, number, min(length, steps - len(rows)), rng):
            taken = counted.step(action)
            reached = simulator.read()
            rows.append((state, action, reached, taken.reward, taken.terminated, taken.observation, number))
            state = reached
            if taken.terminated or taken.truncated or not np.isfinite(reached).all():
                break
        number += 1
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    return Seen(starts, *columns)


def _anywhere(simulator: Simulator, state: Array, rng: np.random.Generator) -> Array:
    """Random positions within their limits, without contacts. If there are none, the state stays unchanged."""
    for _ in range(PLACES_TRIED):
        placed = state.copy()
        for i, variable in enumerate(simulator.variables):
            if variable.motion == "turn" or (variable.motion == "slide" and variable.limited):
                low = -np.pi if variable.low is None else variable.low
                placed[i] = rng.uniform(low, np.pi if variable.high is None else variable.high)
        simulator.write(placed)
        if not simulator.touches():
            return simulator.read()
    simulator.write(state)
    return simulator.read()


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
