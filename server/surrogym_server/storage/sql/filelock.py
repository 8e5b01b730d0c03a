"""One server per SQLite file: a lock on the file itself, which ends with whoever holds it, however they end."""

from __future__ import annotations

import fcntl
import os
import struct
import threading
from pathlib import Path

from surrogym_server.errors import Unavailable

LOCKED_BYTE = 2**62  # beyond any database, and far from the bytes at 2**30 that SQLite locks
WHOLE_DESCRIPTION = getattr(fcntl, "F_OFD_SETLK", None)  # Linux
BUSY = (BlockingIOError, PermissionError)  # EAGAIN, EACCES

BESIDE = ("-wal", "-shm")  # what SQLite puts behind the name of a database: its write-ahead log, and the log's index

Identity = tuple[int, int]  # device and inode

_held: set[Identity] = set()  # files that this process has locked
_turn = threading.Lock()


class FileLock:
    """Held from construction to ``close`` or the end of the process; never inherited by a child process.

    It belongs to the file, under whatever name the file is opened. A file that does not exist is created, empty.
    Close it after SQLite's connections: closing any descriptor of a file drops the locks that SQLite has on it.

    Raises:
        Unavailable: another server holds it, or the file can't be read and written.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        with _turn:
            if _identity(path) in _held:  # and don't open it, for the reason above
                raise _taken(path)
            self._descriptor: int | None = _lock_byte(path) if WHOLE_DESCRIPTION else _lock_beside(path)
            identity = _identity(path)
            assert identity is not None
            self._identity = identity
            self._beside: dict[Path, Identity | None] = {}
            _held.add(identity)

    def watch_beside(self) -> None:
        """Note which write-ahead log and which index of it belong to the file from now on."""
        resolved = self._path.resolve()  # SQLite keeps them where a symbolic link leads
        paths = [resolved.with_name(resolved.name + suffix) for suffix in BESIDE]
        self._beside = {path: _identity(path) for path in paths}

    def require_in_place(self) -> None:
        """Check that the path still leads to the locked file, with the files beside it that were noted.

        Raises:
            Unavailable: one of them was moved, replaced or deleted.
        """
        if _identity(self._path) != self._identity:
            raise _displaced(self._path, "put it back to its place")
        for path, identity in self._beside.items():
            if _identity(path) != identity:
                raise _displaced(path, "stop the server without killing it: then it saves what it still holds")

    def close(self) -> None:
        if self._descriptor is not None:
            os.close(self._descriptor)
            _held.discard(self._identity)
            self._descriptor = None


def _identity(path: Path) -> Identity | None:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino


def _lock_byte(path: Path) -> int:
    """An open file description lock: no other kind of lock meets it on this byte, and only its descriptor ends it."""
    descriptor = _open(path)
    request = struct.pack("hhqqi0q", fcntl.F_WRLCK, os.SEEK_SET, LOCKED_BYTE, 1, 0)  # struct flock
    assert WHOLE_DESCRIPTION is not None
    try:
        fcntl.fcntl(descriptor, WHOLE_DESCRIPTION, request)
    except OSError as error:
        os.close(descriptor)
        raise _taken(path, error) from None
    return descriptor


def _lock_beside(path: Path) -> int:
    """Where a byte can't be locked so, the lock of a file beside the database: the same for every symbolic link."""
    os.close(_open(path))
    resolved = path.resolve()
    descriptor = _open(resolved.with_name(resolved.name + ".lock"))
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(descriptor)
        raise _taken(path, error) from None
    return descriptor


def _open(path: Path) -> int:
    try:
        return os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    except OSError as error:
        raise Unavailable(f"expected a file to read and write the database, got {path}: {error.strerror}") from None


def _displaced(path: Path, way_out: str) -> Unavailable:
    return Unavailable(
        f"the database can't be used now: {path} was moved, replaced or deleted under the running server; {way_out}"
    )


def _taken(path: Path, error: OSError | None = None) -> Unavailable:
    why = "another server has it open" if error is None or isinstance(error, BUSY) else f"no lock: {error.strerror}"
    return Unavailable(f"expected to be the only server on the database {path}, but {why}")
