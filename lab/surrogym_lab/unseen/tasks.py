"""Nine tasks that can be set to any state, and one that can only be reset."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from surrogym_lab.unseen.machine import Array, Machine, Range
from surrogym_shared.spec import EnvironmentSpec


def _bump(distance_squared: Array, width: float) -> Array:
    reward: Array = np.exp(-0.5 * distance_squared / width**2)
    return reward


class NarrowPlane(Machine):
    """A boat in a current that turns; paid within 0.15 of a buoy, in a range of 3 on either side."""

    ranges: ClassVar[Mapping[str, Range]] = {"x": (-3, 3), "y": (-3, 3)}
    start: ClassVar[Mapping[str, Range]] = {"x": (1, 3), "y": (-3, -1)}
    actions = 2

    def formula(self, q: Array, u: Array) -> tuple[Array, Array]:
        x, y = q[..., 0], q[..., 1]
        current = 0.02 * np.stack([-y, x], -1)
        return q + 0.2 * u + current, _bump((x + 1.2) ** 2 + (y - 0.8) ** 2, 0.15)


class NarrowArm(Machine):
    """Four joints, each moved at a rate; paid near one posture."""

    ranges: ClassVar[Mapping[str, Range]] = {f"joint{i}": (-1.5, 1.5) for i in range(4)}
    start: ClassVar[Mapping[str, Range]] = {f"joint{i}": (-1, 1) for i in range(4)}
    actions = 4

    def formula(self, q: Array, u: Array) -> tuple[Array, Array]:
        posture = np.array([0.6, -0.4, 0.9, -0.7])
        return q + 0.1 * u - 0.01 * np.sin(q), _bump(((q - posture) ** 2).sum(-1), 0.3)


class Kinetics(Machine):
    """A cooled tank whose reaction runs away with temperature (Arrhenius); both states without units."""

    ranges: ClassVar[Mapping[str, Range]] = {"conversion": (0, 1), "temperature": (-1, 6)}
    start: ClassVar[Mapping[str, Range]] = {"conversion": (0.1, 0.4), "temperature": (0, 1)}

    def formula(self, q: Array, u: Array) -> tuple[Array, Array]:
        conversion, temperature = q[..., 0], q[..., 1]
        pay = -10 * (conversion - 0.55) ** 2 - 0.01 * u[..., 0] ** 2
        for _ in range(5):
            rate = 0.072 * (1 - conversion) * np.exp(temperature / (1 + temperature / 20))
            conversion, temperature = (
                conversion + 0.03 * (rate - conversion),
                temperature + 0.03 * (8 * rate - temperature + 0.9 * (1.5 * u[..., 0] - temperature)),
            )
        return np.stack([conversion, temperature], -1), pay


class StickSlip(Machine):
    """A sledge that sticks until it is pushed harder than dry friction holds it."""

    ranges: ClassVar[Mapping[str, Range]] = {"x": (-1, 1), "speed": (-1.5, 1.5)}
    start: ClassVar[Mapping[str, Range]] = {"x": (-0.8, 0.8), "speed": (0, 0.1)}

    def formula(self, q: Array, u: Array) -> tuple[Array, Array]:
        x, speed, force = q[..., 0], q[..., 1], 3 * u[..., 0]
        sticks = (np.abs(speed) < 0.05) & (np.abs(force) < 1.0)
        way = np.where(np.abs(speed) < 0.05, np.sign(force), np.sign(speed))
        after = np.where(sticks, 0.0, speed + 0.05 * (force - 0.8 * way - 0.3 * speed))
        return np.stack([x + 0.05 * after, after], -1), -(x**2) - 0.02 * force**2 / 9


class NoisyPendulum(Machine):
    """Pendulum-v1 with process noise of 1 % of each range."""

    ranges: ClassVar[Mapping[str, Range]] = {"theta": (-np.pi, np.pi), "speed": (-8, 8)}
    start: ClassVar[Mapping[str, Range]] = {"theta": (-np.pi, np.pi), "speed": (-1, 1)}
    angles = ("theta",)
    time_limit = 200
    process_noise = 0.01

    def formula(self, q: Array, u: Array) -> tuple[Array, Array]:
        theta, speed, torque = q[..., 0], q[..., 1], 2 * u[..., 0]
        wrapped = (theta + np.pi) % (2 * np.pi) - np.pi
        after = np.clip(speed + 0.05 * (15 * np.sin(theta) + 3 * torque), -8, 8)
        pay = -(wrapped**2) - 0.1 * speed**2 - 0.001 * torque**2
        return np.stack([theta + 0.05 * after, after], -1), pay


class NoisySensors(Machine):
    """A mass between springs, whose sensors err by 1 % of each range."""

    ranges: ClassVar[Mapping[str, Range]] = {"x": (-2, 2), "speed": (-4, 4)}
    start: ClassVar[Mapping[str, Range]] = {"x": (-1.5, 1.5), "speed": (-1, 1)}
    sensor_noise = 0.01

    def formula(self, q: Array, u: Array) -> tuple[Array, Array]:
        x, speed = q[..., 0], q[..., 1]
        after = speed + 0.05 * (4 * u[..., 0] - 2 * x - 0.8 * x**3 - 0.2 * speed)
        return np.stack([x + 0.05 * after, after], -1), -((x - 0.8) ** 2) - 0.05 * speed**2


class Contact(Machine):
    """A slider before an elastic wall at 0.5, to be pressed against it with a given force."""

    ranges: ClassVar[Mapping[str, Range]] = {"x": (-1, 0.8), "speed": (-2, 2)}
    start: ClassVar[Mapping[str, Range]] = {"x": (-0.8, 0.0), "speed": (-0.5, 0.5)}

    def formula(self, q: Array, u: Array) -> tuple[Array, Array]:
        x, speed = q[..., 0], q[..., 1]
        wall = -40 * np.maximum(x - 0.5, 0)
        pay = -((wall + 4) ** 2) / 16 - 0.1 * speed**2
        for _ in range(5):
            wall = np.where(x > 0.5, -40 * (x - 0.5) - 2 * speed, 0.0)
            speed = speed + 0.01 * (6 * u[..., 0] + wall - 0.5 * speed)
            x = x + 0.01 * speed
        return np.stack([x, speed], -1), pay


class FastAndSlow(Machine):
    """A valve that follows in two steps, and a tank that fills in hundreds."""

    ranges: ClassVar[Mapping[str, Range]] = {"valve": (-1, 1), "pressure": (-1, 1), "level": (-1, 1)}
    start: ClassVar[Mapping[str, Range]] = {"valve": (-0.5, 0.5), "pressure": (-0.2, 0.2), "level": (-0.8, 0.2)}
    time_limit = 200

    def formula(self, q: Array, u: Array) -> tuple[Array, Array]:
        valve, pressure, level = q[..., 0], q[..., 1], q[..., 2]
        after = np.stack(
            [
                valve + 0.7 * (u[..., 0] - valve),
                pressure + 0.4 * (valve**3 - 0.5 * pressure - 0.2 * level),
                level + 0.02 * (pressure - 0.3 * level * np.abs(level)),
            ],
            -1,
        )
        return after, -((level - 0.5) ** 2) - 0.1 * pressure**2


class SpringChain(Machine):
    """Six masses in a row between walls, joined by springs that stiffen with the cube; the first and the last are
    pushed. The chain is to come to rest."""

    ranges: ClassVar[Mapping[str, Range]] = {f"{kind}{i}": (-1, 1) for kind in ("x", "v") for i in range(6)}
    start: ClassVar[Mapping[str, Range]] = {f"{kind}{i}": (-0.6, 0.6) for kind in ("x", "v") for i in range(6)}
    actions = 2

    def formula(self, q: Array, u: Array) -> tuple[Array, Array]:
        x, v = q[..., :6], q[..., 6:]
        ends = np.zeros_like(x[..., :1])
        stretch = np.diff(np.concatenate([ends, x, ends], -1), axis=-1)
        tension = 2 * stretch + 4 * stretch**3
        push = np.concatenate([u[..., :1], np.zeros_like(x[..., :4]), u[..., 1:]], -1)
        after = v + 0.08 * (np.diff(tension, axis=-1) - 0.1 * v + 2 * push)
        return np.concatenate([x + 0.08 * after, after], -1), -(x**2).sum(-1) - 0.3 * (v**2).sum(-1)


class ResetOnly:
    """A tilting plate with a ball, which can only be brought to its start and acted on."""

    parallel = True

    def __init__(self) -> None:
        self._plate = _Plate()
        self._rng = np.random.default_rng(0)
        self._q = np.zeros(3)

    def spec(self) -> EnvironmentSpec:
        """Return the specification, known before the first query."""
        return EnvironmentSpec.model_validate({**self._plate.spec().model_dump(), "query": "rollout"})

    def reset(self, *, seed: int | None = None) -> tuple[Array, dict[str, Any]]:
        """Begin an episode; the state (3,)."""
        if seed is not None:
            self._rng = np.random.default_rng(seed)
        low, high = np.array(list(self._plate.start.values())).T
        self._q = self._rng.uniform(low, high)
        return self._q.copy(), {}

    def step(self, action: ArrayLike) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Act (1,); the state (3,) that follows, the reward, and that no episode ends."""
        self._q, reward = self._plate.formula(self._q, np.clip(np.asarray(action, dtype=np.float64), -1, 1))
        return self._q.copy(), float(reward), False, False, {}

    def coordinates(self, observation: Array) -> Array:
        """The state (3,), which is observed."""
        return observation

    def close(self) -> None:
        """Nothing is held."""


class _Plate(Machine):
    ranges: ClassVar[Mapping[str, Range]] = {"x": (-1.5, 1.5), "speed": (-3, 3), "tilt": (-0.5, 0.5)}
    start: ClassVar[Mapping[str, Range]] = {"x": (-0.5, 0.5), "speed": (-0.2, 0.2), "tilt": (-0.1, 0.1)}

    def formula(self, q: Array, u: Array) -> tuple[Array, Array]:
        x, speed, tilt = q[..., 0], q[..., 1], q[..., 2]
        after = speed - 0.05 * (7 * np.sin(tilt) + 0.4 * x**3 + 0.1 * speed)
        turned = np.clip(tilt + 0.05 * (1.5 * u[..., 0]), -0.5, 0.5)
        return np.stack([x + 0.05 * after, after, turned], -1), -((x - 0.3) ** 2) - 0.05 * speed**2 - 0.1 * tilt**2
