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
            _held.add(identity)

    def require_in_place(self) -> None:
        """Check that the path still leads to the locked file.

        Raises:
            Unavailable: the file was moved, replaced or deleted.
        """
        if _identity(self._path) != self._identity:
            raise Unavailable(
                f"the database can't be used now: {self._path} was moved, replaced or deleted under the running "
                "server; put it back to its place"
            )

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


def _taken(path: Path, error: OSError | None = None) -> Unavailable:
    why = "another server has it open" if error is None or isinstance(error, BUSY) else f"no lock: {error.strerror}"
    return Unavailable(f"expected to be the only server on the database {path}, but {why}")
