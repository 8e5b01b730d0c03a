"""The dirt of a machine, found in a few rollouts by evidence: dead time, earlier changes that matter, encoders,
friction that sticks and noise. All functions are pure.

Nothing is found unless its evidence is clear, so that nothing is found in most clean machines.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from surrogym_shared.dirt.dead_time import Explained, explain
from surrogym_shared.dirt.lattice import turns as turns
from surrogym_shared.dirt.lattice import widths
from surrogym_shared.dirt.rollouts import Rollout as Rollout
from surrogym_shared.dirt.rollouts import Sensors as Sensors
from surrogym_shared.dirt.rollouts import sensors as sensors
from surrogym_shared.dirt.stiction import Stiction, sticking

LIKELY = 5.0  # smallest logarithm of the odds for noise that is named
LATE = 8.0  # ... and for a dead time, which is the best one of many
# Noise of all coordinates together must be likely, and that of each named one must have this odds at least.
WEAKLY = 1.0
LEAST_DELAY = 0.2  # a shorter dead time, in steps, is not named
# Noise is named if the standard deviation of a measurement is at least this share of the sampling range, and at least
# this multiple of the width of the coordinate's encoder.
LEAST_NOISE, ABOVE_WIDTH = 4e-3, 1.0


@dataclass(frozen=True)
class Delay:
    """A dead time in steps, the ends of its interval, and the logarithm of the odds that there is one."""

    steps: float
    low: float
    high: float
    odds: float


@dataclass(frozen=True)
class Noise:
    """The standard deviation of the noise of one coordinate's measurement, and the logarithm of the odds for noise."""

    std: float
    odds: float


@dataclass(frozen=True)
class Dirt:
    """What was found in rollouts.

    Attributes:
        explained: how changes follow from states and actions; None if the rollouts are too short for that.
        plain: the same without any earlier changes.
        delay: dead time, or None.
        encoders: width of each encoder, by coordinate.
        stiction: friction that sticks, by coordinate.
        noise: noise, by coordinate; not looked for beside friction.
    """

    explained: Explained | None
    plain: Explained | None
    delay: Delay | None
    encoders: dict[str, float]
    stiction: dict[str, Stiction]
    noise: dict[str, Noise]

    @property
    def named(self) -> bool:
        """Whether anything was found."""
        past = self.explained is not None and self.explained.changes > 0
        return past or bool(self.delay or self.encoders or self.stiction or self.noise)

    @property
    def actions(self) -> int:
        """Number of earlier actions on which the next change depends."""
        if self.explained is None or not (self.delay or self.explained.changes):
            return 0
        return self.explained.actions


def identify(rollouts: Sequence[Rollout], known: Sensors) -> Dirt:
    """Find the dirt of a machine in rollouts, of which some 60 steps are enough for most."""
    both = explain(rollouts, known)
    explained, plain = both or (None, None)
    encoders = widths(rollouts, known)
    delay = None
    if explained is not None and explained.gain > LATE and explained.delay >= LEAST_DELAY:
        delay = Delay(explained.delay, explained.low, explained.high, explained.gain)
    stiction = sticking(rollouts, known, encoders, math.ceil(delay.high) if delay else 0)
    noise = {}
    if explained is not None and not stiction and np.maximum(explained.noisy, 0.0).sum() > LIKELY:
        names = np.array(known.names)[known.moving]
        for name, span, std, odds in zip(
            names, known.span[known.moving], explained.noise, explained.noisy, strict=True
        ):
            if odds > WEAKLY and std > max(LEAST_NOISE * span, ABOVE_WIDTH * encoders.get(name, 0.0)):
                noise[str(name)] = Noise(float(std), float(odds))
    return Dirt(explained, plain, delay, encoders, stiction, noise)
