"""Snapshots that a sampler keeps: files in a folder, bounded in number and in bytes."""

from __future__ import annotations

import hashlib
import json
import os
import secrets
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from surrogym_client.original.errors import SnapshotGone
from surrogym_shared.spec import EnvironmentSpec, limits

FORM = 1  # of the files
ENDING = ".snapshot"
LONGEST_HEAD = 1 << 16  # bytes of a file's first line

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Bounds:
    """Largest number of snapshots, and largest size of their files together, in bytes."""

    count: int = 1_000
    size: int = 1 << 30


@dataclass(frozen=True)
class _Kept:
    """What is known of a file without reading its state."""

    coordinates: tuple[float, ...]  # (C,)
    size: int  # bytes
    made: int  # time of the file, in nanoseconds


class SnapshotFolder:
    """Snapshots in a folder. Several samplers of one surrogate may share it.

    A file has a line of JSON about the snapshot, and then the environment's bytes.

    Args:
        folder: is made if it is not there.
        spec: of the environment. Snapshots of another environment are not used.
        bounds: beyond them, the snapshot that is nearest to another one is dropped.
    """

    def __init__(self, folder: Path, spec: EnvironmentSpec, bounds: Bounds | None = None) -> None:
        self._folder, self._bounds = folder, bounds or Bounds()
        self._environment, self._names = spec.environment, list(spec.coordinate_names)
        self._angles = np.array([c.kind == "angle" for c in spec.coordinates])
        self._widths = np.array([np.ptp(limits(c.sampling)) for c in spec.coordinates])
        self._kept: dict[str, _Kept] = {}
        folder.mkdir(parents=True, exist_ok=True)

    def names(self) -> list[str]:
        """The names of all snapshots that are there and can be used."""
        there = {path.name.removesuffix(ENDING): path for path in self._folder.glob(f"*{ENDING}")}
        for name in self._kept.keys() - there.keys():
            del self._kept[name]
        for name in there.keys() - self._kept.keys():
            try:
                coordinates, _ = self._read(name)
            except SnapshotGone:
                continue
            at = there[name].stat()
            self._kept[name] = _Kept(coordinates, at.st_size, at.st_mtime_ns)
        return sorted(self._kept, key=lambda name: self._kept[name].made)

    def add(self, state: bytes, coordinates: Sequence[float]) -> tuple[str, list[str]]:
        """Keep a state with its coordinates (C,). Returns its name, and the names of those that were dropped for it."""
        name = secrets.token_hex(8)
        head = {
            "form": FORM,
            "environment": self._environment,
            "coordinates": dict(zip(self._names, map(float, coordinates), strict=True)),
            "digest": hashlib.sha256(state).hexdigest(),
        }
        unfinished = self._folder / f"{name}.part"
        unfinished.write_bytes(json.dumps(head).encode() + b"\n" + state)
        os.replace(unfinished, self._path(name))
        return name, self._make_room(name)

    def state(self, name: str) -> bytes:
        """The bytes of a snapshot.

        Raises:
            SnapshotGone: it is not there, damaged, or of another environment or version.
        """
        return self._read(name)[1]

    def drop(self, name: str) -> None:
        """Remove a snapshot; harmless if it is not there."""
        self._kept.pop(name, None)
        self._path(name).unlink(missing_ok=True)

    def _make_room(self, newest: str) -> list[str]:
        dropped: list[str] = []
        names = self.names()
        while len(names) > 1 and self._is_full():
            nearest = least_useful(self._scaled(names), keep=names.index(newest))
            dropped.append(names.pop(nearest))
            self.drop(dropped[-1])
        return dropped

    def _is_full(self) -> bool:
        return len(self._kept) > self._bounds.count or sum(k.size for k in self._kept.values()) > self._bounds.size

    def _scaled(self, names: Sequence[str]) -> Array:
        """Coordinates in widths of the sampling ranges, and angles as points on a circle of circumference 1."""
        q = np.array([self._kept[name].coordinates for name in names])
        turned = q[:, self._angles]
        circle = np.concatenate([np.cos(turned), np.sin(turned)], 1) / (2 * np.pi)
        return np.concatenate([q[:, ~self._angles] / self._widths[~self._angles], circle], 1)

    def _read(self, name: str) -> tuple[tuple[float, ...], bytes]:
        try:
            with self._path(name).open("rb") as file:
                head, state = json.loads(file.readline(LONGEST_HEAD)), file.read()
            form, made_by = head["form"], head["environment"]
            coordinates, digest = head["coordinates"], head["digest"]
        except FileNotFoundError as error:
            raise SnapshotGone(f"snapshot {name} is not in {self._folder}: it was dropped, or is another's") from error
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise SnapshotGone(f"snapshot {name} can't be read: {error}") from error
        if (form, made_by, list(coordinates)) != (FORM, self._environment, self._names):
            raise SnapshotGone(
                f"expected a snapshot of {self._environment!r} in form {FORM}, got {name} of {made_by!r} in form {form}"
            )
        if hashlib.sha256(state).hexdigest() != digest:
            raise SnapshotGone(f"snapshot {name} is damaged: its bytes are not those that were written")
        return tuple(map(float, coordinates.values())), state

    def _path(self, name: str) -> Path:
        return self._folder / f"{Path(name).name}{ENDING}"


def least_useful(points: Array, keep: int) -> int:
    """Number of the older one of the two nearest points (n, K), oldest first, and never ``keep``."""
    apart = np.linalg.norm(points[:, None] - points[None], axis=-1)
    apart[np.diag_indices(len(points))] = np.inf
    nearest = apart.min(1)
    nearest[keep] = np.inf
    return int(nearest.argmin())
