"""A wheel with an encoder of 2,048 counts that wraps, of which the specification says nothing."""

from __future__ import annotations

from typing import Any

import numpy as np

from surrogym_shared.spec import (
    BoxAction,
    Coordinate,
    Design,
    EnvironmentSpec,
    ObservationEntry,
    Term,
    Uniform,
)

COUNTS = 2048
SPEC = EnvironmentSpec(
    environment="a wheel",
    coordinates=(Coordinate(name="x", sampling=Uniform(low=0, high=COUNTS)),),
    observation=(ObservationEntry(name="x", term=Term.linear(x=1)),),
    action=BoxAction(low=(-1.0,), high=(1.0,)),
    start={"x": Uniform(low=900, high=1100)},
    time_limit=20,
    query="rollout",
    design=Design(initial=30, budget=30),
)


class Wheel:
    """Each step turns the wheel by up to 150 counts; the reward is its distance from the middle."""

    parallel = True

    def spec(self) -> EnvironmentSpec:
        return SPEC

    def reset(self, *, seed: int | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        self.x = float(round(np.random.default_rng(seed).uniform(900, 1100)))
        return np.array([self.x]), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        reward = -abs(self.x / COUNTS - 0.5)
        self.x = round(self.x + 150 * float(action[0])) % COUNTS
        return np.array([self.x]), reward, False, False, {}

    def coordinates(self, observation: np.ndarray) -> np.ndarray:
        return observation

    def close(self) -> None:
        pass
