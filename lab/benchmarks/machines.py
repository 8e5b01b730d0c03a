"""Environments of the benchmarks of structure, as formulas. Ranges of most are centred, so that they are mirror
images."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from surrogym_lab.unseen.machine import Machine


class Chain(Machine):
    """Six masses in a row between walls, joined by springs that stiffen with the cube; the third is pushed."""

    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {
        f"{kind}{i}": (-1, 1) for kind in ("x", "v") for i in range(6)
    }
    start: ClassVar[Mapping[str, tuple[float, float]]] = ranges

    def formula(self, q: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, v = q[..., :6], q[..., 6:]
        walls = np.zeros_like(x[..., :1])
        stretch = np.diff(np.concatenate([walls, x, walls], -1), axis=-1)
        force = np.diff(stretch + 3 * stretch**3, axis=-1) - 0.2 * v
        force[..., 2] += 3 * u[..., 0]
        after = v + 0.1 * force
        return np.concatenate([x + 0.1 * after, after], -1), -(x**2).sum(-1) - 0.1 * u[..., 0] ** 2


class Rooms(Machine):
    """Six rooms in a row that exchange heat with their neighbours, the more the larger the difference. The first is
    heated."""

    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {f"T{i}": (-1, 1) for i in range(6)}
    start: ClassVar[Mapping[str, tuple[float, float]]] = ranges

    def formula(self, q: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        over = np.diff(q, axis=-1)
        flow, nothing = 0.15 * over + 0.1 * over * np.abs(over), np.zeros_like(q[..., :1])
        after = q + np.diff(np.concatenate([nothing, flow, nothing], -1), axis=-1)
        after[..., 0] += 0.2 * u[..., 0] * (1.5 - q[..., 0])
        return after, -(q**2).sum(-1)


class Crane(Machine):
    """A crane on a rail with a load on a rope, which a hoist makes longer and shorter."""

    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {
        "x": (-1, 1), "rope": (1, 3), "swing": (-0.8, 0.8), "dx": (-2, 2), "drope": (-1, 1), "dswing": (-2, 2),
    }  # fmt: skip
    start: ClassVar[Mapping[str, tuple[float, float]]] = ranges
    actions: ClassVar[int] = 2

    def formula(self, q: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, rope, swing, dx, drope, dswing = np.moveaxis(q, -1, 0)
        push, hoist = 4 * u[..., 0] - 0.5 * dx, 2 * u[..., 1] - 0.5 * drope
        turn = -(9.81 * np.sin(swing) + push * np.cos(swing) + 2 * drope * dswing) / rope
        dx, drope, dswing = dx + 0.05 * push, drope + 0.05 * hoist, dswing + 0.05 * turn
        after = np.stack([x + 0.05 * dx, rope + 0.05 * drope, swing + 0.05 * dswing, dx, drope, dswing], -1)
        return after, -(x**2) - (rope - 2) ** 2 - swing**2


class Drone(Machine):
    """A drone with two rotors in a vertical plane."""

    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {
        "x": (-1, 1), "z": (-1, 1), "roll": (-1, 1), "dx": (-2, 2), "dz": (-2, 2), "droll": (-3, 3),
    }  # fmt: skip
    start: ClassVar[Mapping[str, tuple[float, float]]] = ranges
    actions: ClassVar[int] = 2  # the sum of the rotors' forces, and their difference

    def formula(self, q: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, z, roll, dx, dz, droll = np.moveaxis(q, -1, 0)
        lift = 10 + 6 * u[..., 0]
        dx = dx + 0.05 * (-lift * np.sin(roll) - 0.3 * dx * np.abs(dx))
        dz = dz + 0.05 * (lift * np.cos(roll) - 10 - 0.3 * dz * np.abs(dz))
        droll = droll + 0.05 * (8 * u[..., 1] - 0.2 * droll)
        after = np.stack([x + 0.05 * dx, z + 0.05 * dz, roll + 0.05 * droll, dx, dz, droll], -1)
        return after, -(x**2) - z**2 - roll**2


class Tanks(Machine):
    """Four tanks in series, each of which drains into the next. The first is filled by a pump."""

    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {f"level{i}": (0.1, 1) for i in range(4)}
    start: ClassVar[Mapping[str, tuple[float, float]]] = ranges

    def formula(self, q: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        out = 0.2 * np.sqrt(q)
        into = np.concatenate([0.1 + 0.1 * u[..., :1], out[..., :-1]], -1)
        return q + into - out, -((q - 0.5) ** 2).sum(-1)


class Ball(Machine):
    """A ball above a springy floor, on a plate that pushes it up and down from afar."""

    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {"height": (-0.1, 1), "speed": (-3, 3)}
    start: ClassVar[Mapping[str, tuple[float, float]]] = ranges

    def formula(self, q: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        height, speed = np.moveaxis(q, -1, 0)
        for _ in range(10):
            force = np.where(height < 0, -400 * height - 4 * speed, 0.0)
            speed = speed + 0.003 * (2 * u[..., 0] - 9.81 + force)
            height = height + 0.003 * speed
        return np.stack([height, speed], -1), -((height - 0.5) ** 2)


class Block(Machine):
    """A finger pushes a block along a table once it touches it; the block slides with friction."""

    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {
        "finger": (-1, 1), "block": (-1, 1), "dfinger": (-1, 1), "dblock": (-1, 1),
    }  # fmt: skip
    start: ClassVar[Mapping[str, tuple[float, float]]] = ranges

    def formula(self, q: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        finger, block, dfinger, dblock = np.moveaxis(q, -1, 0)
        for _ in range(10):
            touch = 60 * np.maximum(finger - block, 0)
            dfinger = dfinger + 0.005 * (5 * u[..., 0] - dfinger - touch)
            dblock = dblock + 0.005 * (touch - 2 * dblock)
            finger, block = finger + 0.005 * dfinger, block + 0.005 * dblock
        return np.stack([finger, block, dfinger, dblock], -1), -((block - 0.5) ** 2)
