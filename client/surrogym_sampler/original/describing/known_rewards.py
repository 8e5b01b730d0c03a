"""Search for a formula of the reward that a specification can declare, from the steps of a description and some further
ones.

Shapes: n steps, C coordinates, F action entries.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from surrogym_sampler.original.describing.counting import Counted
from surrogym_sampler.original.describing.exploring import Seen
from surrogym_sampler.original.describing.rewarding import (
    ENOUGH,
    Paid,
    coefficients,
    may_be_quadratic,
    quadratic_reward,
)
from surrogym_sampler.original.describing.thresholds import threshold_reward
from surrogym_sampler.original.gymnasium import wrapped
from surrogym_sampler.original.protocol import Array
from surrogym_shared.spec import BoxAction, DeclaredReward, EnvironmentSpec, limits


def known_reward(
    counted: Counted, seen: Seen, kept: Sequence[int], spec: EnvironmentSpec, rng: np.random.Generator
) -> DeclaredReward | None:
    """Return a declared reward that is exact for all steps, or None.

    If the explored rewards have at most two values, further steps look for the boundary between the states with one
    value and those with the other. Otherwise, the reward may be a quadratic function that explains most explored steps.
    It is then fitted to further steps from random states, because the explored states may vary too little, and an
    episode may follow a schedule. Half of the further steps are for the fit, the others check it.

    Args:
        counted: a simulator that can be set exactly.
        seen: the explored steps.
        kept: indices of the variables that are coordinates.
        spec: the specification so far.
        rng: draws further states and actions.
    """
    if not isinstance(spec.action, BoxAction):
        return None
    anywhere = _Anywhere(counted, list(kept), spec, spec.action, rng)
    explored = Paid(
        wrapped(spec, seen.states[:, kept]), seen.actions, wrapped(spec, seen.next_states[:, kept]), seen.rewards
    ).at(~seen.terminated)
    if len(np.unique(explored.reward)) <= 2:
        return threshold_reward(spec, explored, anywhere.steps, anywhere.drawn)
    if not may_be_quadratic(spec, explored):
        return None
    taken = anywhere.steps(*anywhere.drawn(2 * math.ceil(ENOUGH * coefficients(spec))))
    half = len(taken) // 2
    return quadratic_reward(spec, taken.at(slice(half)), taken.at(slice(half, None)))


@dataclass(frozen=True)
class _Anywhere:
    """Draws random states and actions, sets the simulator to the states, and takes a real step from each."""

    counted: Counted
    kept: list[int]
    spec: EnvironmentSpec
    action: BoxAction
    rng: np.random.Generator

    def drawn(self, count: int) -> tuple[Array, Array]:
        """Return random states (n, C) of the sampling ranges, and random actions (n, F)."""
        low, high = np.array([limits(c.sampling) for c in self.spec.coordinates]).T
        size = count, self.action.size
        return self.rng.uniform(low, high, (count, len(low))), self.rng.uniform(self.action.low, self.action.high, size)

    def steps(self, places: Array, actions: Array) -> Paid:
        """Take steps from states (n, C) with actions (n, F), and return them without those that end an episode."""
        counted, n = self.counted, len(actions)
        read, reward = np.zeros((n, 2, len(self.kept))), np.full(n, np.nan)
        for i, (place, u) in enumerate(zip(places, actions, strict=True)):
            counted.place(self.kept, place)
            read[i, 0] = counted.read()[self.kept]
            step = counted.step(u)
            if not step.terminated:
                read[i, 1], reward[i] = counted.read()[self.kept], step.reward
        lived = np.isfinite(reward)
        return Paid(wrapped(self.spec, read[:, 0]), actions, wrapped(self.spec, read[:, 1]), reward).at(lived)
