"""Snapshots that a sampler keeps: files in a folder, bounded in number and in bytes."""

from __future__ import annotations

import hashlib
import json
import os
import secrets
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from surrogym_sampler.original.errors import SnapshotGone, SnapshotNotKept, UnusableFolder
from surrogym_shared.spec import EnvironmentSpec, limits

FORM = 1  # of the files
ENDING = ".snapshot"
UNFINISHED = ".part"
ABANDONED_SECONDS = 60.0  # without a change, after which an unfinished file has no writer any more
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
    """Snapshots in a folder. Several samplers of one surrogate may share it, so any file may be gone at any moment.

    A file has a line of JSON about the snapshot, and then the environment's bytes. It is written under another name
    first.

    Args:
        folder: is made if it is not there.
        spec: of the environment. Snapshots of another environment are not used.
        bounds: beyond them, the snapshot that is nearest to another one is dropped.

    Raises:
        UnusableFolder: it can't be made, or not written to.
    """

    def __init__(self, folder: Path, spec: EnvironmentSpec, bounds: Bounds | None = None) -> None:
        self._folder, self._bounds = folder, bounds or Bounds()
        self._environment, self._names = spec.environment, list(spec.coordinate_names)
        self._angles = np.array([c.kind == "angle" for c in spec.coordinates])
        self._widths = np.array([np.ptp(limits(c.sampling)) for c in spec.coordinates])
        self._kept: dict[str, _Kept | None] = {}  # None: can't be used
        self._unknown: Collection[str] = ()
        self._require_room()

    def names(self) -> list[str]:
        """The names of all snapshots that are there and can be used, oldest first."""
        there = {path.name.removesuffix(ENDING): path for path in self._folder.glob(f"*{ENDING}")}
        for name in self._kept.keys() - there.keys():
            del self._kept[name]
        for name in there.keys() - self._kept.keys():
            try:
                coordinates, _ = self.read(name)
                at = there[name].stat()
            except (SnapshotGone, FileNotFoundError):
                self._kept[name] = None
            else:
                self._kept[name] = _Kept(coordinates, at.st_size, at.st_mtime_ns)
        usable = {name: kept for name, kept in self._kept.items() if kept is not None}
        return sorted(usable, key=lambda name: usable[name].made)

    def drop_first(self, unknown: Collection[str]) -> None:
        """Drop these before all others, once there is no room left: the server does not know them."""
        self._unknown = unknown

    def __contains__(self, name: str) -> bool:
        return self._path(name).exists()

    def add(self, state: bytes, coordinates: Sequence[float]) -> tuple[str, list[str]]:
        """Keep a state with its coordinates (C,). Returns its name, and the names of those that were dropped for it.

        Raises:
            SnapshotNotKept: it can't be written, or is larger than all snapshots together may be.
        """
        name = secrets.token_hex(8)
        head = {
            "form": FORM,
            "environment": self._environment,
            "coordinates": dict(zip(self._names, map(float, coordinates), strict=True)),
            "digest": hashlib.sha256(state).hexdigest(),
        }
        content = json.dumps(head).encode() + b"\n" + state
        if len(content) > self._bounds.size:
            raise SnapshotNotKept(
                f"expected a snapshot of at most {self._bounds.size} bytes, which all snapshots together may have, got "
                f"one of {len(content)}: --most-bytes allows more"
            )
        self._write(name, content)
        return name, self._make_room(name)

    def read(self, name: str) -> tuple[tuple[float, ...], bytes]:
        """The coordinates (C,) with which a snapshot was saved, and its bytes.

        Raises:
            SnapshotGone: it is not there, damaged, or of another environment or version.
        """
        try:
            with self._path(name).open("rb") as file:
                head, state = json.loads(file.readline(LONGEST_HEAD)), file.read()
            form, made_by = head["form"], head["environment"]
            coordinates, digest = head["coordinates"], head["digest"]
        except FileNotFoundError as error:
            raise SnapshotGone(
                f"snapshot {name} is not in {self._folder}: it was dropped, or is another's; give all "
                "samplers one --snapshots folder"
            ) from error
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise SnapshotGone(f"snapshot {name} can't be read: {error}; the design takes another state") from error
        if (form, made_by, list(coordinates)) != (FORM, self._environment, self._names):
            raise SnapshotGone(
                f"expected a snapshot of {self._environment!r} in form {FORM}, got {name} of {made_by!r} in "
                f"form {form}: give each environment a --snapshots folder of its own"
            )
        if hashlib.sha256(state).hexdigest() != digest:
            raise SnapshotGone(
                f"snapshot {name} is damaged: its bytes are not those that were written; the design takes another state"
            )
        return tuple(map(float, coordinates.values())), state

    def drop(self, name: str) -> None:
        """Remove a snapshot; harmless if it is not there, or can't be removed."""
        with suppress(OSError):
            self._path(name).unlink()
        self._kept.pop(name, None)

    def _write(self, name: str, content: bytes) -> None:
        unfinished = self._folder / f"{name}{UNFINISHED}"
        try:
            try:
                unfinished.write_bytes(content)
                os.replace(unfinished, self._path(name))
            except BaseException:
                unfinished.unlink(missing_ok=True)
                raise
        except OSError as error:
            raise SnapshotNotKept(
                f"expected to write a snapshot to {self._folder}: {error.strerror or error}; free space, or "
                "name another folder "
                "by --snapshots"
            ) from error

    def _require_room(self) -> None:
        """Make the folder, try to write to it, and remove what killed samplers left unfinished."""
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            probe = self._folder / f"{secrets.token_hex(8)}{UNFINISHED}"
            probe.write_bytes(b"")
            now = probe.stat().st_mtime  # by the clock of the folder's machine
            probe.unlink()
        except OSError as error:
            raise UnusableFolder(
                f"expected a folder for snapshots that can be written to, got {self._folder}: "
                f"{error.strerror or error}; "
                "name another by --snapshots"
            ) from error
        for path in self._folder.glob(f"*{UNFINISHED}"):
            with suppress(OSError):  # another sampler removed it
                if path.stat().st_mtime < now - ABANDONED_SECONDS:
                    path.unlink()

    def _make_room(self, newest: str) -> list[str]:
        """Drop snapshots until the others are within the bounds. Returns their names."""
        dropped: list[str] = []
        names = self.names()
        kept = {name: one for name in names if (one := self._kept[name]) is not None}
        while len(kept) > 1 and self._is_full(kept.values()):
            worst = next((name for name in kept if name in self._unknown), None) or self._nearest(kept, newest)
            dropped.append(worst)
            del kept[worst]
            self.drop(worst)
        return dropped

    def _is_full(self, kept: Collection[_Kept]) -> bool:
        return len(kept) > self._bounds.count or sum(one.size for one in kept) > self._bounds.size

    def _nearest(self, kept: Mapping[str, _Kept], newest: str) -> str:
        """The snapshot that is nearest to another one. Never the newest, which another sampler may have dropped."""
        names = list(kept)
        points = self._scaled([one.coordinates for one in kept.values()])
        return names[least_useful(points, keep=names.index(newest) if newest in kept else None)]

    def _scaled(self, coordinates: Sequence[Sequence[float]]) -> Array:
        """Coordinates (n, C) in widths of the sampling ranges, and angles as points on a circle of circumference 1."""
        q = np.array(coordinates)
        turned = q[:, self._angles]
        circle = np.concatenate([np.cos(turned), np.sin(turned)], 1) / (2 * np.pi)
        return np.concatenate([q[:, ~self._angles] / self._widths[~self._angles], circle], 1)

    def _path(self, name: str) -> Path:
        return self._folder / f"{Path(name).name}{ENDING}"


def least_useful(points: Array, keep: int | None = None) -> int:
    """Number of the older one of the two nearest points (n, K), oldest first, and never ``keep``."""
    nearest = np.full(len(points), np.inf)
    for number, point in enumerate(points):  # all distances at once would fill gigabytes if there are many points
        if number != keep:
            apart = np.square(points - point).sum(1)
            apart[number] = np.inf
            nearest[number] = apart.min()
    return int(nearest.argmin())
