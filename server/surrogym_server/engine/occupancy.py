"""A bounded, uniform sample of the coordinates that one session visited."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

CAPACITY = 4_096


@dataclass(frozen=True)
class Reservoir:
    """Uniform random sample of at most ``CAPACITY`` of the states that a session visited: those of highest priority.

    The priority of the t-th visit is the t-th random number of a generator with the key ``seed``. So the sample does
    not depend on how the visits were divided into requests.
    """

    seed: int
    visits: int = 0  # number of states that the session has visited so far, each visit counted
    # (m, C) coordinates of the m sampled ones of the visited states.
    states: Array = field(default_factory=lambda: np.zeros((0, 0)))
    # (m,) random priority of each sampled state; the sample keeps the states with the highest ones.
    priority: Array = field(default_factory=lambda: np.zeros(0))

    def visit(self, states: Array) -> Reservoir:
        """Return a reservoir that also takes into account n further visits to ``states`` (n, C), in order."""
        priority = _priorities(self.seed, self.visits, len(states))
        full = len(self.priority) == CAPACITY
        candidates = np.flatnonzero(priority > self.priority.min()) if full else np.arange(len(states))
        visits = self.visits + len(states)
        if len(candidates) == 0:
            return Reservoir(self.seed, visits, self.states, self.priority)
        before = self.states if len(self.states) else np.zeros((0, states.shape[1]))
        joined_states = np.concatenate([before, states[candidates]])
        priorities = np.concatenate([self.priority, priority[candidates]])
        rows = np.sort(np.argsort(priorities, kind="stable")[-CAPACITY:])
        return Reservoir(self.seed, visits, joined_states[rows], priorities[rows])


def _priorities(seed: int, first: int, count: int) -> Array:
    """Return the random numbers with the indices ``first`` to ``first + count - 1`` of a generator with the key
    ``seed``, (count,).

    The Philox generator can only start at a multiple of four, so up to three numbers before ``first`` are dropped.
    """
    block, offset = divmod(first, 4)
    generator = np.random.Generator(np.random.Philox(key=seed, counter=block))
    return generator.random(offset + count)[offset:]
