"""Storage of snapshots by a sampler: files in a folder, limited in number and in bytes."""

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

FORM = 1  # version of the format of snapshot files
ENDING = ".snapshot"
UNFINISHED = ".part"
ABANDONED_SECONDS = 60.0  # seconds without a change after which an unfinished file counts as abandoned by its writer
LONGEST_HEAD = 1 << 16  # largest number of bytes of a snapshot file's first line, which describes the snapshot

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Bounds:
    """The largest number of snapshots, and the largest size of their files together, in bytes."""

    count: int = 1_000
    size: int = 1 << 30


@dataclass(frozen=True)
class _Kept:
    """Facts about a snapshot's file, which are known without reading the saved state in it."""

    coordinates: tuple[float, ...]  # (C,) coordinates of the saved state
    size: int  # size of the file in bytes
    made: int  # time at which the file was written, in nanoseconds


class SnapshotFolder:
    """Snapshots in a folder. Several samplers of one surrogate may share it, so any file may disappear at any moment.

    A file has a line of JSON about the snapshot, followed by the environment's bytes. It is written under another name
    first, and then renamed.

    Args:
        folder: the folder, which is made if it does not exist.
        spec: the environment's specification. Snapshots of another environment are not used.
        bounds: limits beyond which the snapshot that is nearest to another one is deleted.

    Raises:
        UnusableFolder: the folder can't be made or written to.
    """

    def __init__(self, folder: Path, spec: EnvironmentSpec, bounds: Bounds | None = None) -> None:
        self._folder, self._bounds = folder, bounds or Bounds()
        self._environment, self._names = spec.environment, list(spec.coordinate_names)
        self._angles = np.array([c.kind == "angle" for c in spec.coordinates])
        self._widths = np.array([np.ptp(limits(c.sampling)) for c in spec.coordinates])
        self._kept: dict[str, _Kept | None] = {}  # what is known about each snapshot, by name; None if it can't be used
        self._unknown: Collection[str] = ()
        self._require_room()

    def names(self) -> list[str]:
        """Return the names of all snapshots in the folder that can be used, oldest first."""
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
        """Set the names of snapshots that the server does not know, so that they are deleted first when space is
        needed."""
        self._unknown = unknown

    def __contains__(self, name: str) -> bool:
        return self._path(name).exists()

    def add(self, state: bytes, coordinates: Sequence[float]) -> tuple[str, list[str]]:
        """Store a state with its coordinates (C,). Returns its name, and the names of the snapshots that were deleted
        to make room.

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
        """Return the coordinates (C,) with which a snapshot was saved, and the environment's bytes.

        Raises:
            SnapshotGone: the snapshot does not exist, is damaged, or is of another environment or version.
        """
        try:
            with self._path(name).open("rb") as file:
                head, state = json.loads(file.readline(LONGEST_HEAD)), file.read()
            form, made_by = head["form"], head["environment"]
            coordinates, digest = head["coordinates"], head["digest"]
        except FileNotFoundError as error:
            raise SnapshotGone(
                f"snapshot {name} is not in {self._folder}: it was deleted, or another sampler has it; give all "
                "samplers the same --snapshots folder"
            ) from error
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise SnapshotGone(f"snapshot {name} can't be read: {error}; the design chooses another query") from error
        if (form, made_by, list(coordinates)) != (FORM, self._environment, self._names):
            raise SnapshotGone(
                f"expected a snapshot of {self._environment!r} with the coordinates {self._names} in file version "
                f"{FORM}, got {name} of {made_by!r} with {list(coordinates)} in file version {form}: give each "
                "environment a --snapshots folder of its own"
            )
        if hashlib.sha256(state).hexdigest() != digest:
            raise SnapshotGone(
                f"snapshot {name} is damaged: its bytes are not those that were written; the design chooses another "
                "query"
            )
        return tuple(map(float, coordinates.values())), state

    def drop(self, name: str) -> None:
        """Delete a snapshot, if it exists and can be deleted."""
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
                f"the snapshot can't be written to {self._folder}: {error.strerror or error}; free space, or give "
                "another folder with --snapshots"
            ) from error

    def _require_room(self) -> None:
        """Make the folder, try to write to it, and delete unfinished files of samplers that were killed."""
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            probe = self._folder / f"{secrets.token_hex(8)}{UNFINISHED}"
            probe.write_bytes(b"")
            now = probe.stat().st_mtime  # the time by the clock of the folder's file system
            probe.unlink()
        except OSError as error:
            raise UnusableFolder(
                f"expected a folder for snapshots that can be written to, got {self._folder}: "
                f"{error.strerror or error}; "
                "name another by --snapshots"
            ) from error
        for path in self._folder.glob(f"*{UNFINISHED}"):
            with suppress(OSError):  # another sampler has removed the file
                if path.stat().st_mtime < now - ABANDONED_SECONDS:
                    path.unlink()

    def _make_room(self, newest: str) -> list[str]:
        """Delete snapshots until the others are within the bounds, and return the names of the deleted ones."""
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
        """Return the name of the snapshot that is nearest to another one. The newest snapshot is never chosen."""
        names = list(kept)
        points = self._scaled([one.coordinates for one in kept.values()])
        return names[least_useful(points, keep=names.index(newest) if newest in kept else None)]

    def _scaled(self, coordinates: Sequence[Sequence[float]]) -> Array:
        """Return coordinates (n, C) as shares of the sampling ranges, with angles as points on a circle of
        circumference 1."""
        q = np.array(coordinates)
        turned = q[:, self._angles]
        circle = np.concatenate([np.cos(turned), np.sin(turned)], 1) / (2 * np.pi)
        return np.concatenate([q[:, ~self._angles] / self._widths[~self._angles], circle], 1)

    def _path(self, name: str) -> Path:
        return self._folder / f"{Path(name).name}{ENDING}"


def least_useful(points: Array, keep: int | None = None) -> int:
    """Find the two nearest of n points of K entries, (n, K), which are ordered from old to new, and return the index of
    the older one. The index ``keep`` is never returned."""
    nearest = np.full(len(points), np.inf)
    for number, point in enumerate(points):  # the matrix of all distances would need gigabytes if there are many points
        if number != keep:
            apart = np.square(points - point).sum(1)
            apart[number] = np.inf
            nearest[number] = apart.min()
    return int(nearest.argmin())
