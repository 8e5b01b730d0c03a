"""How far back one has to look to tell what happens next, from some random episodes of real steps.

A linear regression predicts the next change of each coordinate from the coordinates, the action, and earlier changes
and actions. Histories are compared by errors of left-out steps. A linear regression can't show everything, but it
clearly shows a dead time or a hidden speed.

Shapes: n steps, C coordinates, M of them moving, F action entries, d inputs.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from surrogym_sampler.diagnosis.access import random_action
from surrogym_sampler.original.lags import read_names
from surrogym_sampler.original.protocol import Array, RealStep, RolloutEnvironment
from surrogym_shared.spec import EnvironmentSpec

Bools = NDArray[np.bool_]

LONGEST = 5  # steps to look back
EPISODE = 20  # steps, at most
HELD = 4  # longest time that an action is held
RIDGE = 1e-6  # of the inputs' variance
ENOUGH = 0.05  # of the deviation of a change: a smaller error needs no explanation
SLACK = 1.2  # times the smallest error
EXPLAINED = 0.5  # of the deviation: a regression with a larger error tells nothing
WIDER = 1.5  # times the largest observed change


@dataclass(frozen=True)
class History:
    """How many earlier changes and actions predict the next change. Errors are shares of a change's standard deviation.

    Attributes:
        steps: number of real steps.
        changes: number of earlier changes.
        actions: number of earlier actions.
        error: with them.
        error_without: without any.
        largest: largest observed change of each moving coordinate, widened.
    """

    steps: int
    changes: int
    actions: int
    error: float
    error_without: float
    largest: dict[str, float]

    @property
    def told(self) -> bool:
        """Whether the steps show how far one has to look back."""
        return self.error <= EXPLAINED

    @property
    def call(self) -> str:
        """The call that declares this history."""
        largest = ", ".join(f'"{name}": {most:.2g}' for name, most in self.largest.items())
        named = f", largest={{{largest}}}" if self.changes else ""
        return f"with_history(spec, changes={self.changes}, actions={self.actions}{named})"


@dataclass(frozen=True)
class _Episode:
    """Coordinates that the environment reads (T + 1, R), and actions (T, F)."""

    read: Array
    action: Array


def look_back(environment: RolloutEnvironment, spec: EnvironmentSpec, steps: int) -> History | None:
    """Take random episodes, and find the shortest history that tells the next changes. None if they are too short.

    Raises:
        StepFailed: a step failed.
    """
    episodes = list(_episodes(environment, spec, steps))
    read = [c for c in spec.coordinates if c.name in read_names(spec)]
    turning = np.array([c.kind == "angle" for c in read])
    moving = np.array([c.kind != "constant" for c in read])
    taken = sum(len(episode.action) for episode in episodes)
    errors: dict[tuple[int, int], float] = {}
    for changes, actions in product(range(LONGEST + 1), repeat=2):
        rows = [_rows(episode, changes, actions, turning, moving) for episode in episodes]
        x, y = (np.concatenate(part) for part in zip(*rows, strict=True))
        if len(x) > x.shape[1] + 1:
            errors[changes, actions] = _left_out_error(x, y)
    if (0, 0) not in errors:
        return None
    allowed = max(SLACK * min(errors.values()), ENOUGH)
    found = min((history for history, error in errors.items() if error <= allowed), key=lambda h: (sum(h), h))
    change = np.concatenate([_changes(episode, turning) for episode in episodes])
    largest = WIDER * np.abs(change).max(0)
    named = {c.name: float(most) for c, most, moves in zip(read, largest, moving, strict=True) if moves}
    return History(taken, *found, errors[found], errors[0, 0], named)


def declared(spec: EnvironmentSpec) -> tuple[int, int]:
    """Number of earlier changes and of earlier actions that a specification declares as lags."""
    ages: dict[str, tuple[int, int]] = {}
    for c in spec.coordinates:
        if c.lag is not None and c.lag.kind != "steps":
            before = ages.get(c.lag.of or "", (0, 0))
            of_action = c.lag.kind == "action" or before[1] > 0
            ages[c.name] = (before[0] + (not of_action), before[1] + of_action)
    return max((a for a, _ in ages.values()), default=0), max((b for _, b in ages.values()), default=0)


def _episodes(environment: RolloutEnvironment, spec: EnvironmentSpec, steps: int) -> Iterator[_Episode]:
    """Episodes with ``steps`` steps in all, whose random actions are held for random times."""
    rng, seed = np.random.default_rng(0), 0
    columns = [spec.coordinate_names.index(name) for name in read_names(spec)]
    while steps > 0:
        at, seed = environment.begin(seed), seed + 1
        taken: list[RealStep] = []
        held, action = 0, random_action(spec, rng)
        while len(taken) < min(EPISODE, steps):
            if held == 0:
                held, action = int(rng.integers(1, HELD + 1)), random_action(spec, rng)
            taken.append(environment.act(action))
            held -= 1
            if taken[-1].terminated or taken[-1].truncated:
                break
        steps -= len(taken)
        path = np.array([at, *(step.next_coordinates for step in taken)], dtype=np.float64)
        yield _Episode(path[:, columns], np.array([step.action for step in taken], dtype=np.float64))


def _rows(episode: _Episode, changes: int, actions: int, turning: Bools, moving: Bools) -> tuple[Array, Array]:
    """Inputs (n, d) and next changes (n, M) of an episode's steps, all with the longest history behind them."""
    change, first = _changes(episode, turning)[:, moving], LONGEST
    times = np.arange(first, len(episode.action))
    read = episode.read[times]
    inputs = [read[:, ~turning], np.cos(read[:, turning]), np.sin(read[:, turning])]
    inputs += [change[times - age] for age in range(1, changes + 1)]
    inputs += [episode.action[times - age] for age in range(actions + 1)]
    return np.hstack(inputs), change[times]


def _changes(episode: _Episode, turning: Bools) -> Array:
    """Change in each step (T, R), of angles by the shorter way."""
    change: Array = np.diff(episode.read, axis=0)
    change[:, turning] = (change[:, turning] + np.pi) % (2 * np.pi) - np.pi
    return change


def _left_out_error(x: Array, y: Array) -> float:
    """Error of changes y (n, M) by a linear regression on inputs x (n, d), each step left out in turn: the root mean
    square, as a share of the changes' standard deviation; the largest of the coordinates."""
    spread, size = x.std(0), y.std(0)
    z = np.hstack([np.ones((len(x), 1)), (x - x.mean(0)) / np.where(spread > 0, spread, 1.0)])
    gram = z.T @ z + RIDGE * len(z) * np.eye(z.shape[1])
    hat = z @ np.linalg.solve(gram, z.T)  # (n, n)
    off = (y - hat @ y) / np.clip(1 - hat.diagonal(), 1e-6, None)[:, None]  # PRESS residuals
    return float((np.sqrt((off**2).mean(0)) / np.where(size > 0, size, 1.0)).max())
