"""A step that meets a stop is not smooth, so a described range ends one step before it."""

from __future__ import annotations

import numpy as np
import pytest

from support.toys import Toy
from surrogym_sampler.original.describing import description
from surrogym_sampler.original.simulator import Taken, Variable
from surrogym_shared.spec import BoxAction, limits

STEP = 0.01  # s


class Cart(Toy):
    """A cart on a rail with stops at -1 and 1 m, which take all of its speed. ``push``: m/s^2 of a whole action."""

    def __init__(self, push: float, spread: float) -> None:
        self.variables = (Variable("x", "slide", -1.0, 1.0, driven=True), Variable("x_velocity", "speed"))
        self.action = BoxAction(low=(-1.0,), high=(1.0,))
        self.time_limit, self.rest = 1_000, np.zeros(2)
        self._push, self._spread, self._state = push, spread, self.rest

    def reset(self, seed: int | None) -> np.ndarray:
        self._state = np.array([np.random.default_rng(seed).uniform(-self._spread, self._spread), 0.0])
        return self._state

    def step(self, action: np.ndarray) -> Taken:
        x, speed = self._state
        speed += STEP * self._push * float(action[0])
        moved = x + STEP * speed
        self._state = np.array([moved, speed]) if abs(moved) < 1 else np.array([np.sign(moved), 0.0])
        return Taken(self._state, -(x**2), False, False)


def ranges(monkeypatch: pytest.MonkeyPatch, push: float, spread: float = 0.1) -> dict[str, tuple[float, float]]:
    monkeypatch.setattr(description, "open_simulator", lambda _: Cart(push, spread))
    return {c.name: limits(c.sampling) for c in description.describe("cart", 100).spec.coordinates}


def test_the_described_joint_range_ends_one_step_before_a_mechanical_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    found = ranges(monkeypatch, push=5.0)
    (low, high), (_, fastest) = found["x"], found["x_velocity"]
    assert high + STEP * fastest <= 1 + 1e-9
    assert low - STEP * fastest >= -1 - 1e-9
    assert high - low > 1.9


def test_the_described_joint_range_includes_all_start_states(monkeypatch: pytest.MonkeyPatch) -> None:
    low, high = ranges(monkeypatch, push=5.0, spread=1.0)["x"]
    assert -1 < low < -0.9
    assert 0.9 < high < 1


def test_if_one_step_crosses_much_of_the_range_it_includes_the_stops(monkeypatch: pytest.MonkeyPatch) -> None:
    assert ranges(monkeypatch, push=500.0)["x"] == (-1.0, 1.0)
