"""Shared parts of the tasks: a formula, the ranges of its state, and noise of steps or of sensors."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import count
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from surrogym_sampler.original.protocol import RealStep
from surrogym_shared.spec import BoxAction, Coordinate, EnvironmentSpec, ObservationEntry, Term, Uniform

Array = NDArray[np.float64]
Range = tuple[float, float]
_INSTANCES = count()  # each has noise of its own, the same whenever a program makes them in the same order


class Machine:
    """A task that can be set to any state. Subclasses give what is declared, and ``formula``."""

    parallel = True  # a simulation: several instances may be open at once

    ranges: ClassVar[Mapping[str, Range]]  # of sampling, by coordinate
    start: ClassVar[Mapping[str, Range]]
    angles: ClassVar[tuple[str, ...]] = ()
    actions: ClassVar[int] = 1
    time_limit: ClassVar[int] = 100
    process_noise: ClassVar[float] = 0.0  # deviation, of each range
    sensor_noise: ClassVar[float] = 0.0

    def __init__(self) -> None:
        self._rng = np.random.default_rng([2026, next(_INSTANCES)])

    def formula(self, q: Array, u: Array) -> tuple[Array, Array]:
        """Next states (..., C) and rewards (...) of states q (..., C) under actions u (..., F) in [-1, 1]."""
        raise NotImplementedError

    def spec(self) -> EnvironmentSpec:
        """Return the specification, known before the first query."""
        return EnvironmentSpec(
            environment=type(self).__name__,
            coordinates=tuple(
                Coordinate(name=n, kind="angle" if n in self.angles else "linear", sampling=Uniform(low=low, high=high))
                for n, (low, high) in self.ranges.items()
            ),
            observation=tuple(entry for name in self.ranges for entry in self._shown(name)),
            action=BoxAction(low=(-1.0,) * self.actions, high=(1.0,) * self.actions),
            start={name: Uniform(low=low, high=high) for name, (low, high) in self.start.items()},
            time_limit=self.time_limit,
        )

    def step_from(self, coordinates: Array, action: Array) -> RealStep:
        """One real step from coordinates (C,) under action (F,)."""
        q = np.asarray(coordinates, dtype=np.float64)
        after, reward = self.formula(q, np.clip(np.asarray(action, dtype=np.float64), -1, 1))
        after = after + self._noise(self.process_noise)
        return RealStep(q, action, after + self._noise(self.sensor_noise), float(reward))

    def close(self) -> None:
        """Nothing is held."""

    def _shown(self, name: str) -> tuple[ObservationEntry, ...]:
        if name not in self.angles:
            return (ObservationEntry(name=name, term=Term.linear(**{name: 1})),)
        cosine, sine = Term.cos(**{name: 1}), Term.sin(**{name: 1})
        return ObservationEntry(name=f"cos_{name}", term=cosine), ObservationEntry(name=f"sin_{name}", term=sine)

    def _noise(self, deviation: float) -> Array:
        spans = np.array([high - low for low, high in self.ranges.values()])
        return deviation * spans * self._rng.standard_normal(len(spans))
