"""The states that a description reaches cover the speeds that a policy will meet, whatever the random numbers are."""

from __future__ import annotations

import numpy as np
import pytest

from support.toys import Toy
from surrogym_sampler.original.describing.counting import Counted
from surrogym_sampler.original.describing.exploring import EPISODES, STEPS, Seen, explore
from surrogym_sampler.original.describing.ranges import FASTER
from surrogym_sampler.original.simulator import Taken, Variable
from surrogym_shared.spec import BoxAction

GRAVITY = 20.0  # rad/s^2, of a weightless rod with a mass at its end
FALLEN = 2 * np.sqrt(GRAVITY)  # rad/s: at the bottom, after a fall from upright
STEP = 0.02  # s


class Pendulum(Toy):
    """A pendulum that hangs at ``down`` and is too heavy for its motor. ``touching``: bodies touch away from there."""

    def __init__(self, down: float = 0.0, *, touching: bool = False) -> None:
        self.variables = (Variable("hinge", "turn"), Variable("hinge_velocity", "speed"))
        self.action = BoxAction(low=(-1.0,), high=(1.0,))
        self.time_limit, self.rest = 1_000, np.zeros(2)
        self._down, self._touching = down, touching
        self._state = self.rest

    def reset(self, seed: int | None) -> np.ndarray:
        self._state = np.array([self._down + np.random.default_rng(seed).uniform(-0.1, 0.1), 0.0])
        return self._state

    def step(self, action: np.ndarray) -> Taken:
        angle, speed = self._state
        speed += STEP * (float(action[0]) - GRAVITY * np.sin(angle - self._down))
        self._state = np.array([angle + STEP * speed, speed])
        return Taken(self._state, 0.0, False, False)

    def touches(self) -> bool:
        return self._touching and abs(self._state[0] - self._down) > 0.1


def explored(pendulum: Pendulum, seed: int) -> Seen:
    return explore(Counted(pendulum), STEPS, np.random.default_rng(seed))


def fastest(seen: Seen) -> float:
    return float(np.abs(seen.next_states[:, 1]).max())


@pytest.mark.parametrize("down", [0.0, np.pi, 3.0])
def test_the_described_speed_range_includes_the_speed_of_a_free_fall(down: float) -> None:
    speeds = [fastest(explored(Pendulum(down), seed)) for seed in range(30)]
    assert FASTER * min(speeds) > FALLEN
    assert max(speeds) < 1.2 * FALLEN, "nothing begins in motion, so the range has an end"


def test_choosing_exploration_starts_costs_no_real_step() -> None:
    counted = Counted(Pendulum())
    seen = explore(counted, STEPS, np.random.default_rng(0))
    assert (counted.steps, len(np.unique(seen.episodes))) == (STEPS, EPISODES)


def test_exploration_starts_at_resets_if_other_states_are_in_contact() -> None:
    seen = explored(Pendulum(touching=True), 0)
    starts = [seen.states[np.flatnonzero(seen.episodes == number)[0]] for number in range(EPISODES)]
    assert np.abs(np.array(starts)).max() <= 0.1
