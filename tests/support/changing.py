"""Machines that somebody can change, so that a model of one is wrong for the other.

Each is a formula over arrays: q (..., C) under u (..., F), and parameters by name. A mechanism says which parameters
the machine has while samples are taken; the real one has its own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from surrogym_sampler.original import RealStep
from surrogym_shared.spec import (
    BoxAction,
    Coordinate,
    EnvironmentSpec,
    Inequality,
    ObservationEntry,
    Term,
    Uniform,
)

RIGHT, FEW = "right", "too few samples"
OUT, TURNED, SHIFTED = "a term left out", "a sign turned", "shifted data"

Array = np.ndarray
Parameters = Mapping[str, float]
Formula = Callable[[Array, Array, Parameters], tuple[Array, Array]]  # q, u, parameters: q', reward
Change = Callable[[float], dict[str, float]]  # strength in [0, 1]: parameters while samples are taken


@dataclass(frozen=True)
class Machine:
    """One formula, its parameters, and the mechanisms by which a model of it can be made wrong."""

    name: str
    ranges: Mapping[str, tuple[float, float]]
    start: Mapping[str, tuple[float, float]]
    formula: Formula
    real: Mapping[str, float]
    wrong: Mapping[str, Change]
    few: tuple[int, int]  # samples that are too few, from and to
    budget: int
    actions: int = 1
    noise: float = 0.0  # of each range
    ends: float | None = None  # an episode ends where the first coordinate is beyond
    angles: tuple[str, ...] = ()
    time_limit: int = 60
    best: float | None = None  # real return of a good policy, where no model is learned well enough to show one

    @cached_property
    def spec(self) -> EnvironmentSpec:
        def term(name: str) -> list[tuple[str, Term]]:
            if name in self.angles:
                return [(f"cos {name}", Term.cos(**{name: 1})), (f"sin {name}", Term.sin(**{name: 1}))]
            return [(name, Term.linear(**{name: 1}))]

        first = Term.linear(**{next(iter(self.ranges)): 1})
        sides = (("<", -1), (">", 1)) if self.ends else ()
        return EnvironmentSpec(
            environment=self.name,
            coordinates=tuple(
                Coordinate(name=n, kind="angle" if n in self.angles else "linear", sampling=Uniform(low=low, high=high))
                for n, (low, high) in self.ranges.items()
            ),
            observation=tuple(ObservationEntry(name=n, term=t) for name in self.ranges for n, t in term(name)),
            action=BoxAction(low=(-1,) * self.actions, high=(1,) * self.actions),
            start={n: Uniform(low=low, high=high) for n, (low, high) in self.start.items()},
            time_limit=self.time_limit,
            termination=tuple((Inequality(term=first, relation=r, value=s * (self.ends or 0)),) for r, s in sides),
        )

    def step(self, q: Array, u: Array, parameters: Parameters, rng: np.random.Generator) -> tuple[Array, Array, Array]:
        """Next states, rewards and ends of q (n, C) under u (n, F)."""
        shift = parameters.get("shift", 0.0) * np.eye(q.shape[1])[0]  # the first sensor's zero has moved
        after, reward = self.formula(q - shift, np.clip(u, -1, 1), parameters)
        spans = np.array([high - low for low, high in self.ranges.values()])
        after = after + shift + self.noise * spans * rng.standard_normal(q.shape)
        over = np.zeros(len(q), dtype=bool) if self.ends is None else np.abs(after[:, 0]) > self.ends
        return after, reward + parameters.get("paid", 0.0), over

    def returns(self, policy: Callable[[Array], Array], episodes: int, seed: int) -> Array:
        """Real returns (episodes,) of a policy from the declared starts."""
        rng = np.random.default_rng([seed, 77])
        low, high = np.array(list(self.start.values())).T
        q, total, running = rng.uniform(low, high, (episodes, len(low))), np.zeros(episodes), np.ones(episodes, bool)
        for _ in range(self.time_limit):
            u = np.asarray(policy(self.observe(q)), dtype=float).reshape(episodes, -1)
            q, reward, over = self.step(q, u, self.real, rng)
            total += np.where(running, reward, 0.0)
            running &= ~over
        return total

    def observe(self, q: Array) -> Array:
        """Observations (n, D) of states q (n, C)."""
        columns: list[Array] = []
        for index, name in enumerate(self.ranges):
            columns += [np.cos(q[:, index]), np.sin(q[:, index])] if name in self.angles else [q[:, index]]
        return np.stack(columns, 1).astype(np.float32)


@dataclass
class Changing:
    """A machine as an original environment, whose parameters can be changed between two steps."""

    machine: Machine
    parameters: Parameters
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))

    def spec(self) -> EnvironmentSpec:
        return self.machine.spec

    def step_from(self, coordinates: Array, action: Array) -> RealStep:
        q, u = np.asarray(coordinates, dtype=float)[None], np.asarray(action, dtype=float)[None]
        after, reward, over = self.machine.step(q, u, self.parameters, self.rng)
        return RealStep(coordinates, action, after[0], float(reward[0]), bool(over[0]))

    def close(self) -> None:
        pass


def _mass(q: Array, u: Array, p: Parameters) -> tuple[Array, Array]:
    x, v, push = q[..., 0], q[..., 1], u[..., 0]
    force = 3 * push - p["spring"] * x - 0.5 * v
    reward = np.exp(-0.5 * ((x - 1) / 0.4) ** 2) - 0.01 * push**2
    return np.stack([x + 0.1 * v, v + 0.1 * force], -1), reward


def _cart(q: Array, u: Array, p: Parameters) -> tuple[Array, Array]:
    x, v, push = q[..., 0], q[..., 1], u[..., 0]
    after = np.stack([x + 0.05 * v, v + 0.05 * (5 * push - v + p["wind"])], -1)
    return after, -(x**2 + 0.1 * v**2 + p["price"] * push**2)


def _arm(q: Array, u: Array, p: Parameters) -> tuple[Array, Array]:
    angle, speed, torque = q[..., 0], q[..., 1], u[..., 0]
    acceleration = 8 * torque - p["gravity"] * np.sin(angle) - 0.5 * speed
    speed_after = speed + 0.05 * acceleration
    after = np.stack([angle + 0.05 * speed_after, speed_after], -1)
    return after, np.cos(angle - 1.5) - 0.01 * speed**2 - 0.01 * torque**2


def _pole(q: Array, u: Array, p: Parameters) -> tuple[Array, Array]:
    tilt, spin, x, v = (q[..., i] for i in range(4))
    a = 6 * u[..., 0] - 0.2 * v + p["wind"]
    spin_after = spin + 0.05 * (p["gravity"] * np.sin(tilt) - a * np.cos(tilt))
    v_after = v + 0.05 * a
    after = np.stack([tilt + 0.05 * spin_after, spin_after, x + 0.05 * v_after, v_after], -1)
    return after, 1 - 0.3 * x**2


def _bump(q: Array, u: Array, p: Parameters) -> tuple[Array, Array]:
    return np.clip(q + 0.2 * u, -3, 3), np.exp(-0.5 * ((q - [1.0, -0.5]) ** 2).sum(-1) / p["width"] ** 2)


_MASS = Machine(
    "mass",
    {"x": (-2, 2), "v": (-3, 3)},
    {"x": (-1, 1), "v": (-0.5, 0.5)},
    _mass,
    {"spring": 5.0},
    {
        OUT: lambda s: {"spring": 5.0 * (1 - s)},
        TURNED: lambda s: {"spring": -5.0 * s},
        SHIFTED: lambda s: {"shift": 0.4 + 0.4 * s},
    },
    few=(4, 10),
    budget=40,
)
MACHINES = (
    _MASS,
    replace(_MASS, name="noisy mass", noise=0.01, few=(4, 10), budget=60),
    Machine(
        "cart",
        {"x": (-1, 1), "v": (-2, 2)},
        {"x": (-1, 1), "v": (-1, 1)},
        _cart,
        {"wind": 1.0, "price": 2.0},
        {
            OUT: lambda s: {"price": 1.0 - s},
            TURNED: lambda s: {"price": -s},
            SHIFTED: lambda s: {"shift": 0.4 + 0.4 * s},
        },
        few=(3, 6),
        budget=30,
    ),
    Machine(
        "arm",
        {"angle": (-np.pi, np.pi), "speed": (-6, 6)},
        {"angle": (-1, 1), "speed": (-1, 1)},
        _arm,
        {"gravity": 14.0},
        {
            OUT: lambda s: {"gravity": 14.0 * (1 - s)},
            TURNED: lambda s: {"gravity": -14.0 * s},
            SHIFTED: lambda s: {"shift": 0.8 + 0.6 * s},
        },
        few=(4, 10),
        budget=40,
        angles=("angle",),
    ),
    Machine(
        "pole",
        {"tilt": (-0.4, 0.4), "spin": (-2, 2), "x": (-2, 2), "v": (-2, 2)},
        {"tilt": (-0.1, 0.1), "spin": (-0.1, 0.1), "x": (-0.5, 0.5), "v": (-0.1, 0.1)},
        _pole,
        {"gravity": 10.0, "wind": 4.0},
        {
            OUT: lambda s: {"wind": 4.0 * (1 - s)},
            TURNED: lambda s: {"wind": -4.0 * s},
            SHIFTED: lambda s: {"shift": 0.1 + 0.1 * s},
        },
        few=(6, 12),
        budget=40,
        ends=0.4,
    ),
    Machine(
        "bump",
        {"x": (-3, 3), "y": (-3, 3)},
        {"x": (-3, 3), "y": (-3, 3)},
        _bump,
        {"width": 0.1},
        {},
        few=(30, 100),
        budget=100,
        actions=2,
        best=85.0,
    ),
)


def parameters_of(machine: Machine, mechanism: str, strength: float) -> dict[str, Any]:
    """The machine while samples are taken."""
    return {**machine.real, **(machine.wrong[mechanism](strength) if mechanism in machine.wrong else {})}
