"""A test of how many earlier changes and actions the next change depends on, made with random episodes of real steps.

A linear regression predicts the next change of each coordinate from the coordinates, the action, and earlier changes
and actions. Histories are compared by errors of left-out steps. A linear regression can't show everything, but it
clearly shows a dead time or a hidden speed.

Shapes: n steps, T steps of one episode, C coordinates, R of them read from the environment and not lags, M of those
moving, F action entries, d inputs.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from surrogym_sampler.original.actions import random_action
from surrogym_sampler.original.lags import read_names
from surrogym_sampler.original.protocol import Array, RealStep, RolloutEnvironment
from surrogym_shared.spec import EnvironmentSpec

Bools = NDArray[np.bool_]

# The test compares histories (states with lags) of up to this number of earlier changes, and of earlier actions.
LONGEST = 5
EPISODE = 20  # largest number of steps in an episode of the test
HELD = 4  # largest number of steps for which a random action is held
RIDGE = 1e-6  # ridge term of the linear regression, relative to the variance of its inputs
# A history (past values in the state) suffices if its prediction error is below this share of the standard deviation of
# the changes.
ENOUGH = 0.05
# A history (past values in the state) also suffices if its prediction error is below this multiple of the smallest
# prediction error of all histories.
SLACK = 1.2
# If even the chosen history (past values in the state) has a prediction error above this share of the changes' standard
# deviation, the test can't tell which history is needed.
EXPLAINED = 0.5
WIDER = 1.5  # the declared largest change of a coordinate is this multiple of its largest observed change


@dataclass(frozen=True)
class History:
    """The shortest history that predicts the next change. Errors are shares of a change's standard deviation.

    Attributes:
        steps: number of real steps taken for the test.
        changes: number of earlier changes in the history.
        actions: number of earlier actions in the history.
        error: prediction error with this history.
        error_without: prediction error without earlier changes or actions.
        largest: for each moving coordinate, by name, the change to declare: ``WIDER`` times the observed one.
    """

    steps: int
    changes: int
    actions: int
    error: float
    error_without: float
    largest: dict[str, float]

    @property
    def told(self) -> bool:
        """Whether the regression predicts well enough to show which history is needed."""
        return self.error <= EXPLAINED

    @property
    def call(self) -> str:
        """The call of ``with_history`` that declares this history, as source text."""
        largest = ", ".join(f'"{name}": {most:.2g}' for name, most in self.largest.items())
        named = f", largest={{{largest}}}" if self.changes else ""
        return f"with_history(spec, changes={self.changes}, actions={self.actions}{named})"


@dataclass(frozen=True)
class _Episode:
    """One episode of T steps: the R coordinates that the environment reports at each time (T + 1, R), and the actions
    (T, F)."""

    read: Array
    action: Array


def look_back(environment: RolloutEnvironment, spec: EnvironmentSpec, steps: int) -> History | None:
    """Take random episodes, and find the shortest history that predicts the next changes.

    Args:
        environment: the opened environment; its episodes take ``steps`` real steps.
        spec: its specification.
        steps: number of real steps.

    Returns:
        The history, or None if the episodes are too short for the regression.

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
    """Return the number of earlier changes and of earlier actions that the specification declares as coordinates
    (lags)."""
    ages: dict[str, tuple[int, int]] = {}
    for c in spec.coordinates:
        if c.lag is not None and c.lag.kind != "steps":
            before = ages.get(c.lag.of or "", (0, 0))
            of_action = c.lag.kind == "action" or before[1] > 0
            ages[c.name] = (before[0] + (not of_action), before[1] + of_action)
    return max((a for a, _ in ages.values()), default=0), max((b for _, b in ages.values()), default=0)


def _episodes(environment: RolloutEnvironment, spec: EnvironmentSpec, steps: int) -> Iterator[_Episode]:
    """Yield episodes with ``steps`` real steps in all; each random action is held for a random number of steps."""
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
    """Return the d inputs of the regression (n, d) and the next changes of the M moving coordinates (n, M) in an
    episode.

    The rows are the steps that have at least ``LONGEST`` earlier steps in the episode. So the errors of all histories
    come from the same steps and can be compared.

    Args:
        episode: the episode.
        changes: number of earlier changes among the inputs.
        actions: number of earlier actions among the inputs.
        turning: which coordinates (R,) are angles; they enter as cosine and sine.
        moving: which coordinates (R,) are not constant.
    """
    change, first = _changes(episode, turning)[:, moving], LONGEST
    times = np.arange(first, len(episode.action))
    read = episode.read[times]
    inputs = [read[:, ~turning], np.cos(read[:, turning]), np.sin(read[:, turning])]
    inputs += [change[times - age] for age in range(1, changes + 1)]
    inputs += [episode.action[times - age] for age in range(actions + 1)]
    return np.hstack(inputs), change[times]


def _changes(episode: _Episode, turning: Bools) -> Array:
    """Return the change of each of the R coordinates in each of the T steps (T, R). The change of an angle is the
    shorter way around the circle."""
    change: Array = np.diff(episode.read, axis=0)
    change[:, turning] = (change[:, turning] + np.pi) % (2 * np.pi) - np.pi
    return change


def _left_out_error(x: Array, y: Array) -> float:
    """Return the leave-one-out error of a linear regression of n changes of M coordinates, y (n, M), on d inputs,
    x (n, d). For each coordinate, it is the root mean square error as a share of the standard deviation of the
    coordinate's changes. The largest of these is returned."""
    spread, size = x.std(0), y.std(0)
    z = np.hstack([np.ones((len(x), 1)), (x - x.mean(0)) / np.where(spread > 0, spread, 1.0)])
    gram = z.T @ z + RIDGE * len(z) * np.eye(z.shape[1])
    hat = z @ np.linalg.solve(gram, z.T)  # hat matrix (n, n)
    off = (y - hat @ y) / np.clip(1 - hat.diagonal(), 1e-6, None)[:, None]  # leave-one-out (PRESS) residuals
    return float((np.sqrt((off**2).mean(0)) / np.where(size > 0, size, 1.0)).max())
