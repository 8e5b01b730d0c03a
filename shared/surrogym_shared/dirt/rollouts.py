"""Rollouts as arrays, and the rows of a regression on them.

Shapes: T steps of a rollout, R measured coordinates, M of them moving, F action entries, n rows, d inputs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surrogym_shared.spec import BoxAction, EnvironmentSpec, limits

OTHERS = 0.15  # variance by the noise of other measurements, as a multiple of that by the coordinate's own

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Rollout:
    """One rollout of T steps: the measured coordinates at each time (T + 1, R), and the actions (T, F)."""

    read: Array
    action: Array


@dataclass(frozen=True)
class Sensors:
    """The R measured coordinates.

    Attributes:
        names: their names.
        turning: which are angles (R,).
        moving: which are not constant (R,).
        span: widths of their sampling ranges (R,).
        rest: the action (F,) that counts as none: of each entry the value nearest to 0.
    """

    names: tuple[str, ...]
    turning: Bools
    moving: Bools
    span: Array
    rest: Array


def sensors(spec: EnvironmentSpec) -> Sensors:
    """Return the measured coordinates of a specification: those that are no lags."""
    own = [c for c in spec.coordinates if c.lag is None]
    spans = [high - low for low, high in (limits(c.sampling) for c in own)]
    turning, moving = [c.kind == "angle" for c in own], [c.kind != "constant" for c in own]
    return Sensors(tuple(c.name for c in own), np.array(turning), np.array(moving), np.array(spans), rest_action(spec))


def rest_action(spec: EnvironmentSpec) -> Array:
    """Return the action (F,) that counts as none: of each entry the value nearest to 0."""
    rest = np.zeros(spec.action.size)
    return np.clip(rest, spec.action.low, spec.action.high) if isinstance(spec.action, BoxAction) else rest


def changes(rollout: Rollout, turning: Bools) -> Array:
    """Return the change of each of the R coordinates in each of the T steps (T, R). The change of an angle is the
    shorter way around the circle."""
    change: Array = np.diff(rollout.read, axis=0)
    change[:, turning] = (change[:, turning] + np.pi) % (2 * np.pi) - np.pi
    return change


@dataclass(frozen=True)
class Rows:
    """n steps of rollouts.

    Attributes:
        state: inputs (n, d) that describe the state.
        change: the changes (n, M).
        actions: actions (n, K, F) of the step and of the K - 1 steps before it, latest first. Before a reset, the
            action is that of ``Sensors.rest``.
        noise: covariance (n, n) of the errors of predicted changes, if each measurement has independent noise of
            variance 1: neighbouring steps share measurements.
    """

    state: Array
    change: Array
    actions: Array
    noise: Array


def rows(rollouts: Sequence[Rollout], known: Sensors, past: int, first: int, back: int) -> Rows:
    """Return the steps of rollouts from step ``first`` of each.

    Args:
        rollouts: the rollouts.
        known: the measured coordinates.
        past: number of earlier changes among the inputs, at most ``first``.
        first: number of steps at the beginning of each rollout that are left out.
        back: number of earlier actions.
    """
    parts = [_rows(rollout, known, past, first, back) for rollout in rollouts]
    state, change, actions = (np.concatenate(part) for part in zip(*parts, strict=True))
    noise, begin = np.zeros((len(state), len(state))), 0
    for _, of_one, _ in parts:
        end = begin + len(of_one)
        noise[begin:end, begin:end] = _shared(len(of_one), past)
        begin = end
    return Rows(state, change, actions, noise)


def _shared(count: int, past: int) -> Array:
    """Return the covariance (count, count) of the differences of order ``past`` + 1 of independent numbers: what the
    error of a prediction from the last reading and ``past`` changes is made of, if the state moves little in a step."""
    difference = np.diff(np.eye(count + past + 1), n=past + 1, axis=0)
    covariance: Array = difference @ difference.T
    own = covariance[:1, :1]
    return (covariance + OTHERS * own * np.eye(count)) / (1 + OTHERS)


def _rows(rollout: Rollout, known: Sensors, past: int, first: int, back: int) -> tuple[Array, Array, Array]:
    change = changes(rollout, known.turning)[:, known.moving]
    times = np.arange(first, len(rollout.action))
    read, turning = rollout.read[times], known.turning
    inputs = [read[:, ~turning], np.cos(read[:, turning]), np.sin(read[:, turning])]
    inputs += [change[times - age] for age in range(1, past + 1)]
    padded = np.concatenate([np.tile(known.rest, (back, 1)), rollout.action])
    actions = np.stack([padded[times + back - age] for age in range(back + 1)], axis=1)
    return np.hstack(inputs), change[times], actions
