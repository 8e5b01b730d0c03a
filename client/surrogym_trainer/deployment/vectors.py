"""Test vectors of a controller: steps of episodes, with the answers that the controller must give.

Shapes: R measurements, F action entries.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from surrogym_trainer.deployment.controller import Array, Controller
from surrogym_trainer.deployment.reference import Memory, begin, decide, judged

EPISODES, STEPS, TRIES = 3, 16, 20
WALKED = 20.0  # the random walk of an angle stays within this distance in radians of 0
ROUNDING = 1e-6  # relative error of a measurement that is rounded to float32
# a measurement is used only if rounding it changes the action by at most this share of the action's range
STEADY = 2e-5


@dataclass(frozen=True, eq=False)
class Vector:
    """One step of a test, and the answer that the controller must give."""

    first: bool  # whether this step begins an episode
    measurement: Array  # (R,) value of each of R measurements
    age: float  # age of the measurements in seconds
    status: int
    action: Array  # (F,) action that the controller must give, one number for each of F entries


def vectors_of(controller: Controller, seed: int = 0) -> list[Vector]:
    """Return the test vectors: random walks, ends of the sensors' ranges, and each kind of fault with steps after it.

    A measurement whose rounding to float32 would change the action, such as an angle at half a turn, is left out. If no
    measurement without a fault is left then, such measurements are kept: then float is not precise enough for this
    policy, and the test fails.
    """
    vectors = _vectors_of(controller, np.random.default_rng(seed), only_steady=True)
    if all(vector.status for vector in vectors):
        return _vectors_of(controller, np.random.default_rng(seed), only_steady=False)
    return vectors


def _vectors_of(controller: Controller, rng: np.random.Generator, *, only_steady: bool) -> list[Vector]:
    low, high = sensors_of(controller)
    narrow = _walked(controller)
    inside = low + ROUNDING * (high - low), high - ROUNDING * (high - low)
    vectors: list[Vector] = []
    for _ in range(EPISODES):
        memory, first = begin(controller), True
        walk = rng.uniform(*narrow)
        for step in range(STEPS):
            for _ in range(TRIES):
                drawn = np.clip(walk + rng.normal(0, 0.05, len(low)) * (narrow[1] - narrow[0]), *inside)
                read = drawn.astype(np.float32).astype(np.float64)
                if step == 5:
                    read = (low if rng.random() < 0.5 else high).copy()
                elif judged(controller, read[None], np.zeros(1))[0]:
                    continue  # rounding moved the measurement beyond the end of its range
                if _is_steady(controller, memory, read) or not only_steady:
                    walk = read
                    memory, vector = _answered(controller, memory, first, read, 0.0)
                    vectors.append(vector)
                    first = False
                    break
    memory, first = begin(controller), True
    for read, age in _faults(controller, rng, low, high):
        if age != 0 or not np.isfinite(read).all() or _is_steady(controller, memory, read):
            memory, vector = _answered(controller, memory, first, read, age)
            vectors.append(vector)
            first = False
    return vectors


def sensors_of(controller: Controller) -> tuple[Array, Array]:
    """Return the smallest and the largest valid reading (R,) of each sensor."""
    measurements = controller.measurements
    return np.array([m.lowest for m in measurements]), np.array([m.highest for m in measurements])


def _walked(controller: Controller) -> tuple[Array, Array]:
    """Return the range (R,) of the random walk of each measurement: the range of its sensor. For an angle whose sensor
    counts many turns, it is a few turns only."""
    low, high = sensors_of(controller)
    near = np.clip(0.0, low, high)
    angle = np.array([m.angle for m in controller.measurements])
    return np.where(angle, np.maximum(low, near - WALKED), low), np.where(angle, np.minimum(high, near + WALKED), high)


def _faults(controller: Controller, rng: np.random.Generator, low: Array, high: Array) -> Iterator[tuple[Array, float]]:
    """Yield measurements (R,) and their ages in seconds: faults, each followed by steps without a fault."""
    begun, ended = _walked(controller)

    def sound() -> tuple[Array, float]:
        read = (begun + ended) / 2 + rng.uniform(-0.1, 0.1, len(low)) * (ended - begun)
        return read.astype(np.float32).astype(np.float64), 0.0

    for wrong in (np.nan, np.inf, -np.inf):
        for place in range(len(low)):
            read, _ = sound()
            read[place] = wrong
            yield read, 0.0
            yield sound()
            yield sound()
    for end, sign in ((low, -1), (high, 1)):
        yield end + sign * 0.01 * (high - low), 0.0
        yield sound()
    ages = [np.nan, -1.0, np.inf] + ([] if np.isinf(controller.timeout) else [1.01 * controller.timeout])
    for age in ages:
        if not (age == np.inf and np.isinf(controller.timeout)):
            yield sound()[0], age
            yield sound()


def _answered(controller: Controller, memory: Memory, first: bool, read: Array, age: float) -> tuple[Memory, Vector]:
    decided = decide(controller, memory, read[None], age)
    return decided.memory, Vector(first, read, age, int(decided.status[0]), decided.action[0])


def _is_steady(controller: Controller, memory: Memory, read: Array) -> bool:
    """Return whether rounding the measurements leaves the action unchanged."""
    both = np.stack([read, read * (1 + ROUNDING), read * (1 - ROUNDING)]).clip(*sensors_of(controller))
    repeated = Memory(*(np.repeat(part, 3, axis=0) for part in vars(memory).values()))
    action = decide(controller, repeated, both).action
    middle = action[0]
    return bool((np.abs(action - middle) <= STEADY * (controller.high - controller.low)).all())
