"""Friction that sticks: a coordinate rests under actions that should move it.

A coordinate without such friction passes through changes of 0 as often as through other small changes. So the number of
steps in which it rests is compared with the number of small changes, by a Poisson distribution.

Shapes: T steps of a rollout, R measured coordinates, F action entries.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from surrogym_shared.dirt.rollouts import Array, Rollout, Sensors, changes

FEWEST = 3  # fewest steps in which the coordinate rests
LEVEL = 1e-3  # friction is named if a coordinate without it would rest that often with at most this probability
RESTING = 1e-6  # without an encoder, a change below this share of the largest counts as rest
NEAR = 3  # changes of up to this many widths are the small ones
ANY = 0.5  # small changes that are assumed beside the counted ones


@dataclass(frozen=True)
class Stiction:
    """Friction that sticks.

    Attributes:
        steps: number of steps in which the coordinate rested.
        under: largest action (F,) in these steps.
        chance: probability that a coordinate without friction rests in this number of steps or more.
    """

    steps: int
    under: Array
    chance: float


def sticking(
    rollouts: Sequence[Rollout], known: Sensors, widths: Mapping[str, float], late: int
) -> dict[str, Stiction]:
    """Return the friction of each coordinate, by name, that rests more often than it moves little.

    Args:
        rollouts: the rollouts.
        known: the measured coordinates.
        widths: widths of encoders, by coordinate.
        late: number of steps after which an action has taken effect.
    """
    found = {}
    for i, name in enumerate(known.names):
        if known.moving[i] and (stuck := _sticking(rollouts, known, i, widths.get(name), late)) is not None:
            found[name] = stuck
    return found


def _sticking(rollouts: Sequence[Rollout], known: Sensors, i: int, width: float | None, late: int) -> Stiction | None:
    moved = [changes(rollout, known.turning)[:, i] for rollout in rollouts]
    size = width or 2 * RESTING * max(float(np.abs(m).max()) for m in moved)
    if size == 0:
        return None
    counts = [np.abs(m) / size for m in moved]
    near = sum(int(((c > 0.5) & (c <= NEAR + 0.5)).sum()) for c in counts)
    places: set[float] = set()
    under, steps = np.zeros(len(known.rest)), 0
    for rollout, count in zip(rollouts, counts, strict=True):
        for t in range(late, len(count)):
            acted = rollout.action[max(t - late, 0) : t + 1] - known.rest
            pushed = np.abs(acted).min(0)  # an action that was applied in all steps that may have had an effect
            if count[t] > 0.5 or not pushed.any():
                continue
            # an encoder also shows no change of a plant that came to rest: there, the action must have changed
            if width and not (t > late and count[t - 1] <= 0.5 and _changed(rollout.action, t, late)):
                continue
            steps += 1
            places.add(round(float(rollout.read[t, i]) / size))
            under = np.maximum(under, pushed)
    chance = _at_least(steps, (near + ANY) / (2 * NEAR))
    # at one place alone, it may be a stop
    return Stiction(steps, under, chance) if steps >= FEWEST and len(places) > 1 and chance < LEVEL else None


def _changed(action: Array, t: int, late: int) -> bool:
    return bool(np.ptp(action[max(t - late - 1, 0) : t + 1], axis=0).any())


def _at_least(count: int, mean: float) -> float:
    """Return the probability that a Poisson number with this mean is at least ``count``."""
    return max(1 - sum(math.exp(-mean) * mean**k / math.factorial(k) for k in range(count)), 0.0)
