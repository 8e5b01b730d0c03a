"""Plants from textbooks that can change after a model of them was learned: a levitated ball, a pendulum, two tanks.

Each is a ``Machine``. A change names the parameters of the changed plant; ``delay`` is a number of steps by which the
actuator lags behind.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from support.changing import Array, Changing, Machine, Parameters
from surrogym_sampler.original import RealStep

DT, PARTS = 0.005, 5  # seconds of a step of the levitation, and Euler steps within it
GRAVITY, MIDDLE = 9.81, 0.010  # m/s^2, and the gap in m that is wanted
FORCE, COIL, INDUCTANCE = 1e-4, 10.0, 0.15  # N m^2/A^2, ohm, henry
BALL = 0.06  # kg
AUTHORITY = 0.35  # largest change of the voltage, as a share of that of hovering
HOVER = MIDDLE * float(np.sqrt(BALL * GRAVITY / FORCE))  # A, the current that holds the ball


def _levitation(q: Array, u: Array, p: Parameters) -> tuple[Array, Array]:
    """A ball under an electromagnet: gap in mm about 10 mm, speed in m/s, current in A about that of hovering."""
    gap, speed, current = 1e-3 * q[..., 0] + MIDDLE, q[..., 1], q[..., 2] + HOVER
    voltage = COIL * HOVER * (1 + AUTHORITY * u[..., 0])
    for _ in range(PARTS):
        pull = FORCE * (current / np.maximum(gap, 1e-3)) ** 2 / (BALL * p["mass"])
        gap, speed = gap + DT / PARTS * speed, speed + DT / PARTS * (GRAVITY - pull)
        current = np.maximum(current + DT / PARTS * (voltage * p["pump"] - COIL * current) / INDUCTANCE, 0.0)
    return np.stack([1e3 * (gap - MIDDLE), speed, current - HOVER], -1), 1 - (q[..., 0] / 4) ** 2


def _pendulum(q: Array, u: Array, p: Parameters) -> tuple[Array, Array]:
    """A pendulum that is swung up: angle from upright, speed."""
    angle, speed = q[..., 0], q[..., 1]
    push = 15 * np.sin(angle) + 8 * p["pump"] * u[..., 0] / p["mass"] - p["friction"] * speed / p["mass"]
    after = speed + 0.05 * push
    turned = (angle + 0.05 * after + np.pi) % (2 * np.pi) - np.pi
    return np.stack([turned, after], -1), 0.5 + 0.5 * np.cos(angle) - 0.002 * speed**2 - 0.01 * u[..., 0] ** 2


def _tanks(q: Array, u: Array, p: Parameters) -> tuple[Array, Array]:
    """A pump fills an upper tank, which drains into a lower one, whose level is to be 10 cm. Levels in cm about it.

    Half of the pump's power is not enough to hold the level.
    """
    upper, lower = np.maximum(q[..., 0] + 10, 0), np.maximum(q[..., 1] + 10, 0)
    inflow = 2.2 * p["pump"] * (1 + u[..., 0])
    out, down = (3 * p["drain"] * np.sqrt(level / 10) for level in (upper, lower))
    after = upper + 0.5 * (inflow - out), lower + 0.5 * (out - down)
    return np.stack([np.maximum(level, 0) - 10 for level in after], -1), np.exp(-0.5 * q[..., 1] ** 2)


LEVITATION = Machine(
    "levitation",
    {"gap": (-6, 6), "speed": (-0.4, 0.4), "current": (-0.6, 0.6)},
    {"gap": (-1.5, 1.5), "speed": (-0.02, 0.02), "current": (-0.05, 0.05)},
    _levitation,
    {"mass": 1.0, "pump": 1.0},
    {
        **{f"mass {mass:g}": (lambda _, mass=mass: {"mass": mass}) for mass in (0.7, 0.85, 1.15, 1.3, 1.5)},
        **{f"pump {pump:g}": (lambda _, pump=pump: {"pump": pump}) for pump in (0.7, 0.8, 1.2)},
        "delay 1": lambda _: {"delay": 1.0},
        "offset 2 %": lambda _: {"shift": 0.02 * 12},
    },
    few=(8, 16),
    budget=100,
    noise=0.004,
    ends=6.0,
    time_limit=200,
)
PENDULUM = Machine(
    "pendulum",
    {"angle": (-np.pi, np.pi), "speed": (-9, 9)},
    {"angle": (np.pi - 0.5, np.pi + 0.5), "speed": (-0.3, 0.3)},
    _pendulum,
    {"mass": 1.0, "pump": 1.0, "friction": 0.4},
    {
        "friction x3": lambda _: {"friction": 1.2},
        **{f"mass {mass:g}": (lambda _, mass=mass: {"mass": mass}) for mass in (0.7, 1.3, 1.5)},
        **{f"pump {pump:g}": (lambda _, pump=pump: {"pump": pump}) for pump in (0.7, 1.2)},
        "delay 1": lambda _: {"delay": 1.0},
        "offset 2 %": lambda _: {"shift": 0.02 * 2 * np.pi},
    },
    few=(8, 16),
    budget=60,
    noise=0.001,
    angles=("angle",),
    time_limit=120,
)
TANKS = Machine(
    "tanks",
    {"upper": (-10, 10), "lower": (-10, 10)},
    {"upper": (-5, 5), "lower": (-5, 5)},
    _tanks,
    {"pump": 1.0, "drain": 1.0},
    {
        **{f"pump {pump:g}": (lambda _, pump=pump: {"pump": pump}) for pump in (0.7, 0.85, 1.2)},
        "delay 1": lambda _: {"delay": 1.0},
        "offset 2 %": lambda _: {"shift": 0.02 * 20},
    },
    few=(6, 10),
    budget=40,
    noise=0.002,
    time_limit=100,
)
PLANTS = (LEVITATION, PENDULUM, TANKS)


def real_returns(
    machine: Machine, parameters: Parameters, policy: Callable[[Array], Array], episodes: int, seed: int
) -> tuple[Array, Array]:
    """Returns and lengths (episodes,) of a policy in a plant, from the declared starts."""
    rng = np.random.default_rng([seed, 77])
    low, high = np.array(list(machine.start.values())).T
    q, total, running = rng.uniform(low, high, (episodes, len(low))), np.zeros(episodes), np.ones(episodes, bool)
    pipe = deque([np.zeros((episodes, machine.actions))] * int(parameters.get("delay", 0)))
    lengths = np.zeros(episodes)
    for _ in range(machine.time_limit):
        pipe.append(np.asarray(policy(machine.observe(q)), dtype=float).reshape(episodes, -1))
        q, reward, over = machine.step(q, pipe.popleft(), parameters, rng)
        total += np.where(running, reward, 0.0)
        lengths += running
        running &= ~over
    return total, lengths


@dataclass
class Plant(Changing):
    """A plant as an original environment. Where its actuator lags, it holds no action in a state that was set."""

    _pipe: deque[Array] = field(default_factory=deque, init=False)
    _reached: Array | None = field(default=None, init=False)

    def step_from(self, coordinates: Array, action: Array) -> RealStep:
        u = np.asarray(action, dtype=float)
        if self._reached is None or not np.array_equal(self._reached, coordinates):
            self._pipe = deque([np.zeros_like(u)] * int(self.parameters.get("delay", 0)))
        self._pipe.append(u)
        moved = super().step_from(coordinates, self._pipe.popleft())
        self._reached = np.asarray(moved.next_coordinates)
        return RealStep(coordinates, action, self._reached, moved.reward, moved.terminated)


class Levitation(Plant):
    """The levitated ball."""

    mass = 1.0

    def __init__(self) -> None:
        super().__init__(LEVITATION, {**LEVITATION.real, "mass": self.mass})


class Heavy(Levitation):
    """The same with a ball that is 30 % heavier."""

    mass = 1.3


class Swing(Plant):
    """The pendulum that is swung up."""

    mass = 1.0

    def __init__(self) -> None:
        super().__init__(PENDULUM, {**PENDULUM.real, "mass": self.mass})


class HeavySwing(Swing):
    """The same with a pendulum that is 30 % heavier."""

    mass = 1.3


class TiredSwing(HeavySwing):
    """The same, which is worth less the longer an episode lasts. Single steps do not show it."""

    def step_from(self, coordinates: Array, action: Array) -> RealStep:
        goes_on = self._reached is not None and np.array_equal(self._reached, coordinates)
        moved = super().step_from(coordinates, action)
        return replace(moved, reward=moved.reward - 0.5) if goes_on else moved
